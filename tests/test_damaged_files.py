"""A file with damaged bytes is read as it was written, or refused in one line."""

import json
import pickle
import shutil
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bgpo_trl.data.bank import DemonstrationBank, DemonstrationSteps
from bgpo_trl.data.dataset import load_demonstrations
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.representation import (
    Representation,
    load_representation,
    save_representation,
)
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.scenes.nico import NICO
from tests.helpers import UNPICKLED, Malice

FILES = [f"{key}.memmap" for key in ("pixels", "state", "action", "length", "task", "train")]
FILES += ["dataset.json", "meta.json"]
examples = pytest.mark.parametrize("n", [20, pytest.param(1_000, marks=pytest.mark.slow)])


damages = st.one_of(
    st.tuples(st.just("flip"), st.floats(0, 1, exclude_max=True), st.integers(0, 7)),
    st.tuples(st.just("cut"), st.floats(0, 1), st.none()),
    st.tuples(st.just("insert"), st.floats(0, 1), st.binary(min_size=1, max_size=9)),
    st.tuples(st.just("replace"), st.none(), st.binary(max_size=40)),
    st.tuples(st.just("remove"), st.none(), st.none()),
    st.tuples(st.just("folder"), st.none(), st.none()),
    st.tuples(st.just("malice"), st.none(), st.none()),
)


def do_damage(path: Path, damage) -> None:
    how, where, what = damage
    data = bytearray(path.read_bytes())
    at = None if where is None else int(where * len(data))
    if how in ("remove", "folder"):
        path.unlink()
        if how == "folder":
            path.mkdir()
        return
    if how == "flip":
        data[at] ^= 1 << what
    elif how == "cut":
        del data[at:]
    elif how == "insert":
        data[at:at] = what
    else:
        data = pickle.dumps(Malice()) if how == "malice" else what
    path.write_bytes(data)


def read_or_refused(read, expected) -> None:
    """Checks that reading gives these tensors, or ends in one line with a remedy."""
    try:
        found = read()
    except (ValueError, OSError) as error:
        assert "\n" not in str(error)
        remedies = ("record it again", "resume it", "train-encoders")
        assert any(remedy in str(error) for remedy in remedies)
    else:
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            torch.testing.assert_close(found[key], value, rtol=0, atol=0)
    assert not UNPICKLED


# ---- the dataset


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "one"
    tasks = ["push_green_to_white"]
    record_demonstrations(path, tasks=tasks, per_task=1, held_out_per_task=0, progress=False)
    return path


@pytest.fixture(scope="module")
def expected(recorded) -> dict[str, torch.Tensor]:
    return {key: value.clone() for key, value in load_demonstrations(recorded).items()}


def check_dataset(recorded, expected, damage) -> None:
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(shutil.copytree(recorded, Path(folder) / "copy"))
        damage(copy)
        read_or_refused(lambda: dict(load_demonstrations(copy).items()), expected)


@examples
def test_damaged_bytes_of_a_dataset(recorded, expected, n):
    @settings(max_examples=n)
    @given(name=st.sampled_from(FILES), damage=damages)
    @example(name="meta.json", damage=("malice", None, None))
    @example(name="dataset.json", damage=("folder", None, None))
    def holds(name, damage):
        check_dataset(recorded, expected, lambda copy: do_damage(copy / name, damage))

    holds()


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


@examples
def test_wrong_statements_about_a_dataset(recorded, expected, n):
    known = sorted(json.loads((recorded / "dataset.json").read_text()))

    @settings(max_examples=n)
    @given(key=st.sampled_from(known), value=json_values)
    @example(key="rows", value=10**30)
    @example(key="rows", value=True)
    @example(key="scene_version", value="two\nlines")
    @example(key="tasks", value=[])
    def holds(key, value):
        def damage(copy):
            meta = json.loads((copy / "dataset.json").read_text())
            (copy / "dataset.json").write_text(json.dumps({**meta, key: value}))

        check_dataset(recorded, expected, damage)

    holds()


# ---- encoders and bank, safetensors


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    config = {
        "vae": {"latent_size": 4},
        "lae": {"embedding_size": 2},
        "inverse": {"hidden_size": 512},
    }
    metadata = {"scene": NICO.identity, "config": json.dumps(config), "seed": "0", "command": ""}
    small = Representation(VAE(4), SequenceAutoencoder(4, 2), InverseModel(4), metadata)
    save_representation(small, folder / "encoders")
    task, length = torch.arange(3), torch.tensor([0, 2, 3])
    steps = DemonstrationSteps.of(torch.rand(3, 3, 2), torch.rand(3, 2, 4), length)
    bank = DemonstrationBank(
        torch.rand(3, 2), task, task > 0, ("a", "b, c", "d"), steps, "x", scene="some 1"
    )
    bank.save(folder / "bank")
    return folder


def read_bank(path: Path) -> dict[str, torch.Tensor]:
    bank = dict(vars(DemonstrationBank.load(path, encoder_id="x")))
    steps = vars(bank.pop("steps"))
    bank |= {key: value for key, value in steps.items() if value is not None}
    texts = {key: bank[key] for key in ("encoder_id", "scene")}
    texts["tasks"] = ",".join(bank["tasks"])
    bank["spread"] = torch.tensor(bank["spread"])
    return bank | {key: torch.tensor(list(text.encode())) for key, text in texts.items()}


def read_encoders(path: Path) -> dict[str, torch.Tensor]:
    encoders = load_representation(path, scene=NICO)
    return {**encoders.frame_network.state_dict(), **encoders.lae.state_dict(prefix="lae.")}


@examples
@pytest.mark.parametrize("read", [read_bank, read_encoders])
def test_damaged_tensors(files, read, n):
    path = files / read.__name__.removeprefix("read_")
    expected = {key: value.clone() for key, value in read(path).items()}

    @settings(max_examples=n)
    @given(damage=damages, of_header=st.booleans())
    @example(damage=("malice", None, None), of_header=False)
    @example(damage=("folder", None, None), of_header=False)
    @example(damage=("flip", 0.6, 0), of_header=False)
    @example(damage=("flip", 0.999, 0), of_header=False)
    def holds(damage, of_header):
        how, where, what = damage
        if where is not None and of_header:  # Few of the bytes, but they say what the others are.
            size = path.stat().st_size
            header = 8 + int.from_bytes(path.read_bytes()[:8], "little")
            damage = how, where * header / size, what
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(shutil.copy(path, folder))
            do_damage(copy, damage)
            read_or_refused(lambda: read(copy), expected)

    holds()
