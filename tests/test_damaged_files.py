"""A file with damaged bytes is read as it was written, or refused in one line."""

import json
import pickle
import shutil
import tempfile
from collections.abc import Callable
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
from tests.helpers import POINTER, UNPICKLED, Malice

FILES = [f"{key}.memmap" for key in ("pixels", "state", "action", "length", "task", "train")]
FILES += ["dataset.json", "meta.json"]
REMEDIES = ("record it again", "resume it", "train-encoders", "git lfs pull")
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


def read_dataset(folder: Path) -> dict[str, torch.Tensor]:
    return dict(load_demonstrations(folder).items())


def read_bank(folder: Path) -> dict[str, torch.Tensor]:
    bank = dict(vars(DemonstrationBank.load(folder / "bank", encoder_id="x")))
    steps = vars(bank.pop("steps"))
    bank |= {key: value for key, value in steps.items() if value is not None}
    texts = {key: bank[key] for key in ("encoder_id", "scene")}
    texts["tasks"] = ",".join(bank["tasks"])
    bank |= {key: torch.tensor(bank[key]) for key in ("spread", "noise")}
    return bank | {key: torch.tensor(list(text.encode())) for key, text in texts.items()}


def read_encoders(folder: Path) -> dict[str, torch.Tensor]:
    encoders = load_representation(folder / "encoders", scene=NICO)
    return {**encoders.frame_network.state_dict(), **encoders.lae.state_dict(prefix="lae.")}


READ = {"dataset": read_dataset, "bank": read_bank, "encoders": read_encoders}


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict[str, Path]:
    """Folders with the files of a dataset, of a bank and of encoders."""
    folders = {kind: tmp_path_factory.mktemp(kind) for kind in READ}
    options = {"tasks": ["push_green_to_white"], "per_task": 1, "held_out_per_task": 0}
    record_demonstrations(folders["dataset"], **options, progress=False)
    config = {
        "vae": {"latent_size": 4},
        "lae": {"embedding_size": 2},
        "inverse": {"hidden_size": 512},
    }
    metadata = {"scene": NICO.identity, "config": json.dumps(config), "seed": "0", "command": ""}
    small = Representation(VAE(4), SequenceAutoencoder(4, 2), InverseModel(4), metadata)
    save_representation(small, folders["encoders"] / "encoders")
    task, length = torch.arange(3), torch.tensor([0, 2, 3])
    steps = DemonstrationSteps.of(torch.rand(3, 3, 2), torch.rand(3, 2, 4), length)
    bank = DemonstrationBank(
        torch.rand(3, 2), task, task > 0, ("a", "b, c", "d"), steps, "x", scene="some 1"
    )
    bank.save(folders["bank"] / "bank")
    return folders


@pytest.fixture
def check(written) -> Callable[..., None]:
    """Check that a damaged copy is read as it was written, or refused in a line with a remedy."""
    expected = {}

    def check(kind, damage):
        if kind not in expected:
            content = READ[kind](written[kind]).items()
            expected[kind] = {key: value.clone() for key, value in content}
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(shutil.copytree(written[kind], Path(folder) / "copy"))
            damage(copy)
            try:
                found = READ[kind](copy)
            except (ValueError, OSError) as error:
                assert "\n" not in str(error)
                assert any(remedy in str(error) for remedy in REMEDIES)
            else:
                assert found.keys() == expected[kind].keys()
                for key, value in expected[kind].items():
                    torch.testing.assert_close(found[key], value, rtol=0, atol=0)
        assert not UNPICKLED

    return check


@examples
@pytest.mark.parametrize("kind", READ)
def test_damaged_bytes(written, check, kind, n):
    names = FILES if kind == "dataset" else [kind]

    @settings(max_examples=n)
    @given(name=st.sampled_from(names), damage=damages, of_header=st.booleans())
    @example(name=names[-1], damage=("malice", None, None), of_header=False)
    @example(name=names[-2:][0], damage=("folder", None, None), of_header=False)
    @example(name=names[0], damage=("replace", None, b"version https://git-lfs"), of_header=False)
    @example(name=names[0], damage=("flip", 0.6, 0), of_header=False)
    @example(name=names[0], damage=("flip", 0.999, 0), of_header=False)
    def holds(name, damage, of_header):
        how, where, what = damage
        if kind != "dataset" and where is not None and of_header:
            # Few of the bytes of tensors, but they say what the others are.
            content = (written[kind] / name).read_bytes()
            header = 8 + int.from_bytes(content[:8], "little")
            damage = how, where * header / len(content), what
        check(kind, lambda copy: do_damage(copy / name, damage))

    holds()


@pytest.mark.parametrize(
    ("kind", "name"),
    [("dataset", name) for name in FILES[:-1]] + [(k, k) for k in READ if k != "dataset"],
)
def test_pointers_of_git_lfs_are_named(written, tmp_path, kind, name):
    copy = Path(shutil.copytree(written[kind], tmp_path / "copy"))
    (copy / name).write_bytes(POINTER)
    with pytest.raises(ValueError, match=rf"{name} is a pointer of Git LFS: .* git lfs pull"):
        READ[kind](copy)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


@examples
def test_wrong_statements_about_a_dataset(written, check, n):
    known = sorted(json.loads((written["dataset"] / "dataset.json").read_text()))

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

        check("dataset", damage)

    holds()
