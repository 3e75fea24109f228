"""Probes against known maps, and which frames they read."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.mismatch import doubt_frames, mismatch
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.probes import (
    complaints,
    probe,
    reconstruction_picture,
    ridge_predict,
    share_lost,
    verdict,
    verdict_in,
)
from bgpo_trl.encoders.representation import Representation, encode_frames
from bgpo_trl.encoders.train import make_bank
from bgpo_trl.modules.frame_network import FrameNetwork
from bgpo_trl.modules.inverse_model import InverseModel
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.modules.vae import VAE
from bgpo_trl.scenes.nico import NICO
from tests.helpers import noise_demonstrations


def demonstrations(n: int = 6) -> TensorDict:
    return noise_demonstrations(range(2, 2 + n), held_out=2)


@pytest.fixture
def untrained() -> Representation:
    torch.manual_seed(0)
    return Representation(VAE(), SequenceAutoencoder(), InverseModel(), {})


def test_ridge_regression_finds_a_linear_map_at_any_scale() -> None:
    x, x_new = torch.randn(500, 5), torch.randn(40, 5)
    scale, weight = torch.tensor([1e-3, 1.0, 1e3, 1.0, 0.0]), torch.randn(5, 3)

    def truth(x: torch.Tensor) -> torch.Tensor:
        return x[:, :4] @ weight[:4] + 7

    predicted = ridge_predict(x * scale, truth(x), x_new * scale, penalty=1e-8)
    torch.testing.assert_close(predicted, truth(x_new), rtol=1e-3, atol=1e-3)


def test_demonstrations_unlike_those_of_the_encoders_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = {"per_task": 2, "held_out_per_task": 1, "seed": 9, "progress": False}
    dataset = record_demonstrations(tmp_path / "shown", **recording)
    encoders = load_pretrained()[0]
    latent, action = encode_frames(encoders.frame_network, dataset), dataset["action"]
    inferred = encoders.inverse(latent, dataset["length"])
    none, network = torch.zeros_like(action[:, :1]), encoders.frame_network
    phi = encoders.lae.encode(latent, dataset["length"])
    for changed, said in (
        (action, None),
        (torch.cat([none, action[:, :-1]], 1), "a step too late"),
        (torch.cat([action[:, 1:], none], 1), "a step too early"),
        (0.2 * action, "0.20 times as large as frames suggest"),
        (action * torch.tensor([1.0, -1.0, 1.0, 1.0]), "component 1 .* opposite sign"),
        (
            action[..., [1, 0, 2, 3]],
            r"component 0 \(from 0\) of recorded actions moves what component 1 moved",
        ),
        (action + torch.tensor([0.0, 0.0, 0.3, 0.0]), r"component 2 .* is \+0.\d+ off"),
        (torch.rand_like(action) - 0.5, "little to do with what frames show"),
    ):
        found = mismatch(network, dataset.clone().update({"action": changed}), inferred, phi)
        assert re.search(said, found) if said else not found, found
    shown = dataset["pixels"][0, : dataset["length"][0]]
    wide = shown.float()
    for frames, said in (
        (shown, None),
        (shown.flip(-1), "red and blue exchanged: give them red first"),
        (shown.flip(2), "mirrored: place"),
        (shown.flip(1), "upside down"),
        (shown.flip(1, 2), "turned by 180 degrees"),
        (0.75 * wide, "1.4 times as bright"),
        ((1.3 * wide).clamp(0, 255), "0.7 times as bright"),
        (shown.roll(1, 1), "1 pixel farther up"),
        (shown.roll(-3, 2), "3 pixels farther right"),
        (torch.rand(shown.shape) * 255, None),  # of which nothing can be told
    ):
        found = doubt_frames(network, frames.to(torch.uint8))
        assert said in found if said else not found, found
    blue = dataset.clone().update({"pixels": dataset["pixels"].flip(-1)}).exclude("action")
    with pytest.warns(UserWarning, match="better with red and blue exchanged"):
        make_bank(encoders, blue, tasks=NICO.default_tasks)
    # A poor encoder, whose errors are half as large as that of the mean frame or larger.
    noise = 0.12 * torch.randn(32, 64, 3, generator=torch.Generator().manual_seed(0))
    decode = network.decode
    monkeypatch.setattr(network, "decode", lambda z: decode(z) + noise)
    with torch.no_grad():
        usual = network.decode(network.latent_mean.unsqueeze(0))
        own = network.decode(network.encode(shown)[0])
    assert (wide / 255 - own).square().mean() > 0.5 * (wide / 255 - usual).square().mean()
    assert doubt_frames(network, shown) == ""
    assert "give them red first" in doubt_frames(network, shown.flip(-1))


class Blind(FrameNetwork):
    """A frame encoder without a decoder, of which nothing else can be told."""

    identity = "blind 1"

    def features(self, frames: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(frames), 64)


def test_tasks_that_are_mixed_up_are_told(bank: DemonstrationBank) -> None:
    """Unless there are fewer than eight demonstrations for each task."""
    frames = torch.zeros(len(bank.task), 2, 32, 64, 3, dtype=torch.uint8)
    length = torch.full([len(bank.task)], 2)
    shown = TensorDict({"pixels": frames, "length": length, "task": bank.task}, [len(frames)])

    def found(task: torch.Tensor, n: int) -> str:
        some = shown.clone().set("task", task)[:n]
        return mismatch(Blind(64, (32, 64)), some, None, bank.embedding[:n])

    assert found(bank.task, 36) == ""
    mixed = torch.where(torch.arange(36) % 4 == 0, bank.task.roll(1), bank.task)
    phi = bank.embedding.numpy()
    apart = np.linalg.norm(phi[:, None] - phi, axis=-1) + 1e9 * np.eye(36)
    own = (mixed.numpy()[apart.argmin(1)] == mixed.numpy()).mean()
    assert found(mixed, 36).startswith(f"{own:.0%} of the demonstrations are nearest to one of")
    assert found(mixed, 23) == ""


def test_picture_shows_frames_over_reconstructions(untrained: Representation) -> None:
    data = demonstrations()
    picture = reconstruction_picture(untrained.frame_network, data, columns=5)
    assert picture.shape == (2 * 32 * 4, 5 * 64 * 4, 3)
    assert torch.equal(picture[:128:4, :256:4], data["pixels"][0, 0])
    decoded = untrained.frame_network.decode(
        untrained.frame_network.encode(data["pixels"][0, 0])[0]
    )
    assert (picture[128::4, :256:4] / 255 - decoded).abs().max() < 0.51 / 255
    last = picture[:128:4, -256::4]
    assert (last == data["pixels"][5, :7]).flatten(1).all(-1).any(), "of a valid step"


def test_probes_leave_out_a_ground_truth_that_was_not_recorded(untrained: Representation) -> None:
    data = demonstrations().exclude("state", "action")
    result = probe(untrained, data, play=data, columns=NICO.state)
    assert result == probe(untrained, data)


def test_probes_are_not_fitted_on_held_out_demonstrations(untrained: Representation) -> None:
    """Two held-out demonstrations of three: measuring on one alone is fitting on the same four."""
    data = demonstrations()
    data["state"][data["train"]] = 0.5
    result = probe(untrained, data, columns=NICO.state)
    error = data["state"][4:, :, 0] - 0.5
    valid = torch.arange(7) < data["length"][4:].unsqueeze(-1)
    expected = error[valid].square().mean().sqrt().item()
    assert result["joint_yaw_rmse_rad"] == pytest.approx(expected, rel=1e-3)


def test_frames_beyond_the_length_do_not_count(untrained: Representation) -> None:
    data = demonstrations()
    expected = probe(untrained, data, columns=NICO.state)
    beyond = torch.arange(7) >= data["length"].unsqueeze(-1)
    data["pixels"][beyond] = 7
    data["state"][beyond] = 1e6
    data["action"][beyond[:, 1:]] = 1e6
    assert probe(untrained, data, columns=NICO.state) == pytest.approx(expected)


def test_frames_of_play_with_a_fallen_object_are_left_out(untrained: Representation) -> None:
    play = demonstrations(9)
    play["state"][..., 7:] = 0.7
    play["state"][:, 1, 15] = 0.1  # the white box has just fallen
    play["state"][:, 1, 0] = 1e6
    result = probe(untrained, demonstrations(), play=play, columns=NICO.state)
    assert result.items() >= probe(untrained, demonstrations(), columns=NICO.state).items()
    assert 0.01 < result["play_joint_yaw_rmse_rad"] < 10
    assert result["play_white_error_cm"] == pytest.approx(0, abs=1e-2)


def test_a_small_thing_that_is_lost_counts_as_much_as_a_large_one_that_is_seen():
    background = torch.zeros(20, 30, 3)
    frames = background.repeat(4, 1, 1, 1)
    frames[:, 2:12, 2:12] = 0.8  # the robot
    frames[:3, 15:17, 20:22, 0] = 1.0  # an object of four pixels
    frames[3, 15, 20] = 1.0  # too small for a thing
    frames[:, 18, 1:9] = 0.1  # too faint
    assert share_lost(frames, frames, background) == 0
    seen = frames.clone()
    seen[:3, 15:17, 20:22] = 0
    assert share_lost(frames, seen, background) == 3 / 7
    seen[0, 15:17, 20:22, 0] = 0.4  # of its squared difference, .64 is reconstructed
    assert share_lost(frames, seen, background) == 2 / 7
    assert share_lost(frames, background.expand_as(frames), background) == 1
    assert share_lost(background[None], background[None], background) == 0


def test_the_verdict_judges_by_the_bounds_of_the_complaints(tmp_path):
    good = {"moving_reconstruction": 0.5, "things_lost": 0.1, "task_accuracy_nearest": 0.9}
    good |= {"inverse_r2": 0.5, "task_accuracy_chance": 0.5}
    assert complaints(good) == []
    assert [line.split()[-1] for line in verdict(good).splitlines()] == ["ok"] * 4
    worse = {"moving_reconstruction": 0.49, "things_lost": 0.11, "task_accuracy_nearest": 0.89}
    for key, value in {**worse, "inverse_r2": 0.49}.items():
        wrong = {**good, key: value}
        assert len(complaints(wrong)) == 1
        (line,) = (line for line in verdict(wrong).splitlines() if line.endswith("not good"))
        assert f" {value:.2f} " in line
    (tmp_path / "probes.json").write_text(json.dumps({**good, "inverse_r2": 0.49}))
    assert verdict_in(tmp_path, NICO) == verdict({**good, "inverse_r2": 0.49})
    (tmp_path / "reconstructions.png").touch()
    recorded = verdict_in(tmp_path, replace(NICO, bank_actions="recorded"))
    assert recorded.endswith(f"\nlook for every object in {tmp_path / 'reconstructions.png'}")
    assert "not good" not in recorded


def test_an_untrained_vae_loses_all_things(untrained: Representation) -> None:
    assert probe(untrained, demonstrations())["things_lost"] > 0.9
