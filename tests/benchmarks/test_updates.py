"""Contenders of the update benchmark do the work that they are timed for."""

import sys
from importlib.util import find_spec

import pytest
import torch

from benchmarks.speed import updates
from benchmarks.speed.updates import BATCH, Floor, Ours, TorchRLLoop, contenders, floor_batch
from benchmarks.speed.versions import Training


def weights(ours: Ours) -> list[torch.Tensor]:
    loss = ours.loss
    return [
        tensor
        for params in (
            loss.actor_network_params,
            loss.value_network_params,
            loss.target_actor_network_params,
            loss.target_value_network_params,
        )
        for tensor in params.values(True, True)
    ]


def floor_weights(floor: Floor) -> list[torch.Tensor]:
    return [*floor.actor, *floor.critic, *floor.target_actor, *floor.target_critic]


def test_the_floor_is_our_arithmetic_without_clipping_and_penalty(monkeypatch):
    # In larger sums, rounding errors grow beyond the tolerance within three updates.
    monkeypatch.setattr(updates, "HIDDEN", 64)
    ours = Ours(3, transitions=BATCH, return_bounds=None, pre_tanh_penalty=0.0)
    floor = Floor(ours.loss)
    start = [tensor.detach().clone() for tensor in weights(ours)]
    for _ in range(3):
        batch = ours.sample()
        floor.learn(*floor_batch(batch))
        ours.learn(batch)
    for mine, theirs, before in zip(weights(ours), floor_weights(floor), start, strict=True):
        torch.testing.assert_close(mine.detach(), theirs.detach(), rtol=1e-4, atol=1e-5)
        assert not torch.equal(mine, before)


def test_torchrls_loop_moves_every_weight():
    loop = TorchRLLoop(transitions=BATCH)
    before = {key: value.clone() for key, value in loop.loss.state_dict().items()}
    loop.update()
    after = loop.loss.state_dict()
    for network in ("actor_network_params", "value_network_params"):
        for prefix in ("", "target_"):
            moved = [
                not torch.equal(value, after[key])
                for key, value in before.items()
                if key.startswith(prefix + network + ".") and value.numel() > 1
            ]
            assert moved and all(moved)


def test_every_contender_makes_its_updates():
    found = contenders(seeds=2, transitions=BATCH)
    assert ("Stable-Baselines3" in found) == (find_spec("stable_baselines3") is not None)
    assert found["ours, 2 seeds"][1] == found["floor, 2 seeds, without sampling"][1] == 2
    for call, count in found.values():
        assert count > 0
        call()


def test_a_missing_stable_baselines3_is_left_out_and_said(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    assert "Stable-Baselines3" not in contenders(seeds=1, transitions=BATCH)
    assert "pip install" in capsys.readouterr().out


@pytest.mark.slow
def test_a_step_by_which_versions_are_compared_is_the_sum_of_its_parts_and_trains():
    training = Training(seeds=1, experts=2, rows=16)
    loss = training.algorithm.experts.learner.loss
    before = [parameter.clone() for parameter in loss.parameters()]
    assert {len(parameter[0]) for parameter in before} == {2}
    *parts, whole = training.time(1)
    assert min(parts) > 0 and sum(parts) == pytest.approx(whole)
    for parameter, start in zip(loss.parameters(), before, strict=True):
        assert parameter.ne(start).flatten(2).any(-1)[0, 0].all()
