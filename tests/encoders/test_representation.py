"""Training of the encoders on two squares on grey, moved by the components of the action."""

import csv
import json
import warnings
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    SequenceAutoencoderConfig,
    VAEConfig,
)
from bgpo_trl.encoders import fitting
from bgpo_trl.encoders.fitting import retrain_inverse, train_representation
from bgpo_trl.encoders.probes import _probe_reconstruction, probe
from bgpo_trl.encoders.representation import (
    Representation,
    load_representation,
    mean_frame,
    save_representation,
    split,
    valid_frames,
)
from bgpo_trl.encoders.train import make_bank, train_encoders
from bgpo_trl.scenes.nico import NICO
from tests.helpers import TINY_ENCODERS
from tests.scenes.dot import scene

TASKS = NICO.default_tasks

CONFIG = RepresentationConfig(
    vae=VAEConfig(
        batch_size=16,
        window=2,
        steps=130,
        learning_rate=2e-3,
        warmup_steps=10,
        kl_weight=0.01,
        inverse_weight=10.0,
    ),
    lae=SequenceAutoencoderConfig(batch_size=32, steps=60, learning_rate=1e-2, warmup_steps=10),
    inverse=InverseModelConfig(hidden_size=64, batch_size=128, steps=300, warmup_steps=10),
    checkpoint_every=50,
)
ALL_ACTIONS = replace(TINY_ENCODERS.inverse, largest_action=1.0)
TINY = replace(TINY_ENCODERS, inverse=ALL_ACTIONS, checkpoint_every=1, log_every=2)
LIMITED = replace(TINY, inverse=replace(TINY.inverse, largest_action=0.6))
ROBOT = scene(frame_shape=(32, 64), action_size=4, tasks=("left", "right", "up"))
OF_ROBOT = {"scene": ROBOT, "tasks": ROBOT.tasks, "progress": False}
DIRECTIONS = np.array([[1, 0, 0, 0], [-1, 0, 0, 1], [0, 1, -1, 0]])  # of both squares, by task


def squares(n: int) -> TensorDict:
    """Demonstrations of three ways to move a red and a green square of 8 pixels."""
    rng = np.random.default_rng(0)
    pixels = np.zeros((n, 51, 32, 64, 3), np.uint8)
    action = np.zeros((n, 50, 4), np.float32)
    state = np.zeros((n, 51, 16), np.float32)
    task = np.arange(n) % 3
    length = rng.integers(6, 11, n)
    for i in range(n):
        place = rng.uniform([16, 8, 16, 8], [40, 16, 40, 16])  # x, y, x, y of the corners
        for t in range(length[i]):
            pixels[i, t] = 60
            for corner, color in ((place[:2], (230, 30, 30)), (place[2:], (30, 230, 30))):
                x, y = np.round(corner).astype(int)
                pixels[i, t, y : y + 8, x : x + 8] = color
            state[i, t, :4] = place / 32
            state[i, t, 7:9], state[i, t, 10:12] = place[:2] / 100, place[2:] / 100
            if t < length[i] - 1:
                action[i, t] = 0.6 * DIRECTIONS[task[i]] + rng.uniform(-0.4, 0.4, 4)
                place = np.clip(place + 4 * action[i, t], 0, [55, 23, 55, 23])
    arrays = {"pixels": pixels, "action": action, "length": length, "state": state, "task": task}
    entries = {key: torch.from_numpy(values) for key, values in arrays.items()}
    return TensorDict({**entries, "train": torch.arange(n) < 0.8 * n}, [n])


@pytest.fixture(scope="module")
def dataset() -> TensorDict:
    return squares(120)


def train(dataset: TensorDict, config: RepresentationConfig = TINY, **options) -> Representation:
    options = {"scene": "squares 1", "progress": False, **options}
    return train_representation(dataset, config, **options)


@pytest.fixture(scope="module")
def tiny() -> Representation:
    return train(squares(8), command="make weights")


def same(a: Representation, b: Representation) -> bool:
    return all(
        torch.equal(x, y)
        for m, n in ((a.frame_network, b.frame_network), (a.lae, b.lae), (a.inverse, b.inverse))
        for x, y in zip(m.state_dict().values(), n.state_dict().values(), strict=True)
    )


def test_encoders_as_published_have_constant_rates_no_keypoints_and_no_inverse_model(
    tmp_path: Path,
) -> None:
    published = replace(
        TINY,
        vae=replace(TINY.vae, keypoints=False, warmup_steps=1, decay=False),
        lae=replace(TINY.lae, warmup_steps=1, decay=False),
        inverse=replace(TINY.inverse, steps=0),
        log_every=1,
    )
    rows = []
    made = train(squares(8), published, log=rows.append)
    rates = {stage: getattr(published, stage).learning_rate for stage in ("vae", "lae")}
    assert {row["stage"] for row in rows} == rates.keys()
    assert all(row["learning_rate"] == rates[row["stage"]] for row in rows)
    assert made.inverse is None
    save_representation(made, tmp_path / "encoders.safetensors")
    read = load_representation(tmp_path / "encoders.safetensors")
    assert read.inverse is None
    assert read.identity == made.identity
    latent = read.frame_network.latent(squares(8)["pixels"][:, 0])
    assert latent.equal(made.frame_network.latent(squares(8)["pixels"][:, 0]))


def test_encoders_capture_frames_places_actions_and_tasks(dataset: TensorDict) -> None:
    """Held-out errors of the probes, against guessing the mean of the training set."""
    probed = probe(train(dataset, CONFIG), dataset, columns=NICO.state)
    assert probed["reconstruction"] < 0.6 * probed["mean_frame_reconstruction"]
    positions = [
        part["state"][torch.arange(51) < part["length"].unsqueeze(-1)] for part in split(dataset)
    ]
    for name, first in (("glass", 7), ("green", 10)):
        here = slice(first, first + 2)
        guess = positions[1][:, here] - positions[0][:, here].mean(0)
        assert probed[f"{name}_error_cm"] < 0.5 * 100 * guess.norm(dim=-1).mean()
    assert probed["inverse_r2"] > 0.3
    assert probed["task_accuracy_linear"] > 0.8
    assert probed["task_accuracy_nearest"] > 0.8
    assert probed["sequence_mse"] < 0.6


def test_weights_depend_on_seed_and_training_part_and_not_on_global_state(
    tiny: Representation,
) -> None:
    data = squares(8)
    data["pixels"][~data["train"]] = 0
    torch.manual_seed(77)
    state = torch.get_rng_state()
    assert same(tiny, train(data))
    assert torch.equal(torch.get_rng_state(), state)
    assert not same(tiny, train(data, replace(TINY, seed=1)))


def test_play_is_held_out_only_where_it_is_probed(tmp_path: Path) -> None:
    play, blind = squares(10), replace(NICO, state=None)
    play["train"] = torch.ones(10, dtype=torch.bool)
    arguments = (squares(8), play, tmp_path / "weights.safetensors", tmp_path / "run", TINY)
    with pytest.raises(ValueError, match=r"recorded play has no held-out .* held_out_per_task of"):
        train_encoders(*arguments, tasks=TASKS, scene=NICO)
    assert not [*tmp_path.iterdir()]  # nothing was trained before
    train_encoders(*arguments, tasks=TASKS, scene=blind)
    play["train"] = torch.zeros(10, dtype=torch.bool)
    with pytest.raises(ValueError, match="recorded play has no episodes to train on"):
        train(squares(8), play=play)


def test_the_frame_encoder_learns_from_the_training_part_of_play() -> None:
    play = squares(10)
    trained, held_out_changed = train(squares(8), play=play), play.clone()
    together = torch.cat([valid_frames(d[d["train"]]) for d in (squares(8), play)])
    torch.testing.assert_close(trained.frame_network.mean_frame, mean_frame(together))
    held_out_changed["pixels"][~play["train"]] = 0
    assert same(trained, train(squares(8), play=held_out_changed))


def test_the_inverse_model_alone_is_trained_as_with_the_other_encoders(tmp_path: Path) -> None:
    play, more = squares(10), squares(14)
    trained = train(squares(8), play=play, command="first")
    assert same(trained, retrain_inverse(trained, play, TINY, progress=False))
    none = replace(TINY, inverse=replace(TINY.inverse, steps=0))
    with pytest.raises(ValueError, match="an inverse model of 0 steps"):
        retrain_inverse(trained, play, none, progress=False)
    wider = replace(TINY, inverse=replace(TINY.inverse, hidden_size=16))
    with_more = retrain_inverse(trained, more, wider, command="then", progress=False)
    assert same(trained, replace(with_more, inverse=trained.inverse))
    config = {**json.loads(trained.metadata["config"]), "inverse": asdict(wider.inverse)}
    changes = {"command": "first; then", "config": json.dumps(config)}
    assert with_more.metadata == {**trained.metadata, **changes}

    weights = tmp_path / "weights.safetensors"
    of_nico = {"tasks": TASKS, "scene": NICO}
    again = partial(train_encoders, weights=weights, config=wider, keep=trained, **of_nico)
    written, _ = again(squares(8), more, folder=tmp_path / "more")
    assert same(written, with_more) and same(load_representation(weights), with_more)
    with pytest.raises(ValueError, match="give the folder of recorded play"):
        again(squares(8), None, folder=tmp_path / "nothing")
    limited = replace(wider, inverse=replace(wider.inverse, largest_action=0.6))
    assert not (tmp_path / "nothing").exists()
    with pytest.raises(ValueError, match=r"largest_action 0\.6 leaves 100% of the actions out"):
        again(with_a_gripper(8), more, config=limited, folder=tmp_path / "bold")


def test_training_writes_weights_log_and_probes(tmp_path: Path) -> None:
    folder, weights = tmp_path / "run", tmp_path / "weights.safetensors"
    play = squares(10)
    play["state"][..., 7:] = 1.0  # on the table
    with pytest.warns(UserWarning) as caught:
        trained, _ = train_encoders(
            squares(8), play, weights, folder, TINY, tasks=TASKS, scene=NICO, command="make weights"
        )
    said = "".join(str(warning.message) for warning in caught)
    assert "of what moves in frames: look for the objects in recon" in said
    assert "actions inferred from frames have an R2 of" in said  # NICO's bank has these
    loaded = load_representation(weights, scene=NICO)
    assert same(trained, loaded)
    assert loaded.metadata["command"] == "make weights"
    rows = list(csv.DictReader((folder / "train.csv").open()))
    assert [row["stage"] for row in rows] == ["vae", "vae", "lae", "lae", "inverse", "inverse"]
    assert [row["step"] for row in rows] == 3 * ["2", "4"]
    weighted_kl = TINY.vae.kl_weight * float(rows[0]["kl"])
    assert float(rows[0]["loss_kl"]) == pytest.approx(weighted_kl)
    assert json.loads((folder / "probes.json").read_text()) == probe(
        loaded, squares(8), play=play, columns=NICO.state
    )
    assert (folder / "reconstructions.png").exists()


def with_a_gripper(n: int) -> TensorDict:
    """Demonstrations whose last action opens or closes a gripper, at its ends, as most do."""
    dataset = squares(n)
    dataset["action"][..., 3] = torch.where(dataset["task"] == 0, 1.0, -1.0).unsqueeze(-1)
    return dataset


def test_actions_that_the_inverse_model_would_never_see_are_refused_before_training() -> None:
    log: list[dict] = []
    bold = squares(8)
    seen = bold[bold["train"]]
    steps = [seen["action"][row, : length - 1] for row, length in enumerate(seen["length"])]
    large = f"{(torch.cat(steps).abs().amax(-1) > 0.6).double().mean():.0%}"
    for part, share in ((with_a_gripper(8), "100%"), (bold, large)):
        match = f"largest_action 0.6 leaves {share} of the actions out, most by component .,"
        for play in (None, squares(8)):
            with pytest.raises(ValueError, match=match):
                train(part, LIMITED, play=play, log=log.append)
    with pytest.raises(ValueError, match="leaves 100% of the actions out, most by component 3"):
        play = with_a_gripper(8)
        train(squares(8).exclude("action"), LIMITED, play=play, log=log.append)
    assert not log


def test_steps_of_play_that_are_left_out_are_told_unless_demonstrations_have_none() -> None:
    """Component 3 is larger on average, but never beyond the largest."""
    play = squares(8)
    play["action"][..., :3].clamp_(-0.1, 0.1)
    play["action"][..., 3] = 0.5
    play["action"][:, :2, 1] = -1.0
    share = 2 / float((play["length"][play["train"]] - 1).double().mean())
    shown = play.clone()
    shown["action"].clamp_(-0.5, 0.5)
    told = (
        f"leaves {share:.0%} of the actions out, most by component 1, .* if demonstrations have n"
    )
    with pytest.warns(UserWarning, match=told):
        train(shown.exclude("action"), LIMITED, play=play)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "largest_action")
        train(shown, LIMITED, play=play)


def test_actions_beyond_the_largest_teach_the_inverse_model_nothing(tiny: Representation) -> None:
    play = squares(10)
    turned, large = play.clone(), play["action"].abs().amax(-1, keepdim=True) > 0.6
    turned["action"] = torch.where(large, -play["action"], play["action"])
    first, second = (retrain_inverse(tiny, p, LIMITED, progress=False) for p in (play, turned))
    assert same(first, second)


def test_actions_of_any_size_are_learned_from_and_recorded_ones_are_used(tmp_path: Path) -> None:
    """NICO's limit, below which all its demonstrators stay, is NICO's alone."""
    shown = with_a_gripper(8)
    config = replace(TINY, inverse=replace(TINY.inverse, largest_action=None))
    parts = (shown, None, tmp_path / "weights", tmp_path / "run", config)
    with pytest.warns(UserWarning) as caught:
        trained, bank = train_encoders(*parts, **OF_ROBOT)
    assert not any("actions inferred" in str(warning.message) for warning in caught)
    assert json.loads(trained.metadata["config"])["inverse"]["largest_action"] == 1.0
    assert trained.inverse is not None and bank.steps is not None
    moves = torch.arange(int(bank.steps.length[0]) - 1)
    kept = bank.steps.actions(moves + bank.steps.first[0])
    torch.testing.assert_close(kept, shown["action"][0, moves], rtol=0, atol=0.5 / 127)
    assert kept[:, 3].unique().tolist() == [1.0]
    inferred = make_bank(trained, shown, tasks=ROBOT.tasks, actions="inferred")
    assert not inferred.steps.action.equal(bank.steps.action)
    unknown = make_bank(trained, shown.exclude("action"), tasks=ROBOT.tasks)
    assert unknown.steps.action.equal(inferred.steps.action)


def test_recorded_actions_are_compared_with_inferred_ones_if_play_tells_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else, the inverse model has learned from these very actions."""
    monkeypatch.setattr("bgpo_trl.encoders.train.mismatch", lambda *_: "actions are turned round")
    shown = with_a_gripper(8)
    for name, play in (("alone", None), ("play", shown)):
        folder = tmp_path / name
        with pytest.warns(UserWarning) as caught:
            train_encoders(shown, play, folder / "weights", folder, TINY, **OF_ROBOT)
        assert any("turned" in str(w.message) for w in caught) == (play is not None)


def test_a_folder_is_locked_while_encoders_are_trained_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else, two trainings would mix their rows and their checkpoints."""
    locked = []

    def fit(*_: Any, **__: Any) -> None:
        locked.append((tmp_path / "fit" / "lock").exists())
        raise KeyboardInterrupt

    monkeypatch.setattr("bgpo_trl.encoders.train.train_representation", fit)
    parts = (with_a_gripper(8), None, tmp_path / "weights", tmp_path / "fit", TINY)
    with pytest.raises(KeyboardInterrupt):
        train_encoders(*parts, **OF_ROBOT)
    assert locked == [True]


def test_what_moves_is_measured_apart_from_what_stands_still(dataset: TensorDict) -> None:
    """By a frame encoder that reconstructs half of the deviation from the mean frame."""
    parts = split(dataset)
    mean = mean_frame(valid_frames(parts[0]))
    halving: Any = SimpleNamespace(
        encode=lambda frames: (frames / 255 - mean,), decode=lambda deviation: mean + deviation / 2
    )
    found = _probe_reconstruction(halving, *parts)
    assert found["moving_reconstruction"] == pytest.approx(0.75)
    share = found["reconstruction"] / found["mean_frame_reconstruction"]
    assert share == pytest.approx(0.25)


def test_datasets_that_cannot_be_trained_on_are_refused() -> None:
    with pytest.raises(ValueError, match="16 frames"):
        train(squares(8), replace(TINY, vae=replace(TINY.vae, window=16, batch_size=16)))
    assert squares(8)["length"].min() < 7  # a shorter one than a window is left out
    train(squares(8), replace(TINY, vae=replace(TINY.vae, window=8, batch_size=16)))
    shown = squares(8).set("train", torch.ones(8, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"the dataset has no held-out .* held_out_per_task of at"):
        train(shown)


def test_bfloat16_is_left_out_where_it_would_be_emulated(monkeypatch, tiny):
    monkeypatch.setattr(fitting, "has_bfloat16", lambda _: False)
    with pytest.warns(UserWarning, match="no instructions for bfloat16"):
        other = train(squares(8), replace(TINY, vae=replace(TINY.vae, bfloat16=True)))
    assert other.identity == tiny.identity


def test_a_checkpoint_of_a_training_on_other_data_is_not_resumed(tmp_path):
    first, others = squares(8), squares(12)
    trained = train(first, checkpoint=tmp_path / "all", play=first)
    assert same(trained, train(first, checkpoint=tmp_path / "all", play=first))
    retrained = retrain_inverse(trained, first, TINY, progress=False, checkpoint=tmp_path / "kept")
    for changed in ({"dataset": others, "play": first}, {"dataset": first, "play": others}):
        with pytest.raises(ValueError, match="a training on other data"):
            train(**changed, checkpoint=tmp_path / "all")
    for encoders, play in ((trained, others), (train(others), first)):
        with pytest.raises(ValueError, match="a training on other data"):
            retrain_inverse(encoders, play, TINY, progress=False, checkpoint=tmp_path / "kept")
    again = retrain_inverse(trained, first, TINY, progress=False, checkpoint=tmp_path / "kept")
    assert same(retrained, again)
