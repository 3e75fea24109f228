"""The benchmarks of speed: timing, contenders that do the work they are timed for, GWR-B."""

import json
from importlib.util import find_spec

import pytest
import torch
from timing import Timing, interleave, ratio

from benchmarks.speed import gwr, updates
from benchmarks.speed.updates import BATCH, Floor, Ours, contenders, floor_batch


def weights(ours: Ours) -> list[torch.Tensor]:
    networks = ("actor_network", "value_network", "target_actor_network", "target_value_network")
    params = [getattr(ours.loss, f"{name}_params") for name in networks]
    return [tensor for of_network in params for tensor in of_network.values(True, True)]


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
    learned = [*floor.actor, *floor.critic, *floor.target_actor, *floor.target_critic]
    for mine, theirs, before in zip(weights(ours), learned, start, strict=True):
        torch.testing.assert_close(mine.detach(), theirs.detach(), rtol=1e-4, atol=1e-5)
        assert not torch.equal(mine, before)


def test_every_contender_makes_its_updates():
    found = contenders(seeds=2, transitions=BATCH)
    assert ("Stable-Baselines3, TD3" in found) == (find_spec("stable_baselines3") is not None)
    assert found["ours, 2 seeds"][1] == found["floor, 2 seeds, without sampling"][1] == 2
    for call, count in found.values():
        assert count > 0
        call()


def test_contenders_take_turns_and_only_rounds_after_the_warmup_count():
    now, calls = [0.0], []

    def contender(name, seconds):
        def call():
            calls.append(name)
            now[0] += seconds

        return call

    times = interleave(
        {"a": contender("a", 1.0), "b": contender("b", 3.0)},
        rounds=2,
        warmup=1,
        clock=lambda: now[0],
    )
    assert calls == ["a", "b"] * 3
    assert times == {"a": [1.0, 1.0], "b": [3.0, 3.0]}


def test_quartiles_and_ratios_by_hand():
    assert Timing.of([5.0, 1.0, 3.0, 2.0, 4.0]) == Timing(median=3.0, low=2.0, high=4.0)
    # A slow spell of the machine leaves a ratio as it is.
    assert ratio([2.0, 20.0, 2.0], [1.0, 10.0, 1.0]) == Timing(2.0, 2.0, 2.0)


def test_results_are_written_and_printed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch, "set_num_threads", lambda n: None)
    gwr.main(
        gwr.Arguments(tmp_path, nodes=(20, 40), networks=2, batch_nodes=30, features=4, rounds=3)
    )
    result = json.loads((tmp_path / "gwr.json").read_text())
    assert [(row["networks"], row["nodes"]) for row in result["single"]] == [(1, 20), (1, 40)]
    assert (result["batch"]["networks"], result["batch"]["nodes"]) == (2, 30)
    for row in (*result["single"], result["batch"]):
        for call in ("lookup", "adapt", "lookup + adapt", "read"):
            assert 0 < row[call]["low"] <= row[call]["median"] <= row[call]["high"]
        assert row["lookup + adapt"]["median"] > row["read"]["median"]
        assert row["bytes_per_node"] > 4 * 4
    assert (result["exponent"]["from"], result["exponent"]["to"]) == (20, 40)
    assert (tmp_path / "gwr.png").read_bytes().startswith(b"\x89PNG")
    assert "| 2 | 30 |" in capsys.readouterr().out


def test_exponent_of_a_power_law_is_its_power():
    rows = [{"nodes": n, "call": {"median": 3 * n**0.5}} for n in (10, 70, 900)]
    assert gwr.slope(rows, "call") == pytest.approx(0.5)


def test_networks_are_full_and_as_asked_for():
    network, weights, held = gwr.make_gwr(3, 50, 8)
    assert network.num_nodes.tolist() == [50] * 3
    assert weights.shape == (3, 50, 8)
    for i in range(3):
        assert torch.equal(network.graph(i).weights, weights[i])
        assert len(network.graph(i).edges) == 49 + 48 + 47
    assert held > weights.nbytes
    assert len(network.adapt(weights[:, 7]).node.unique()) == 1  # node 7, everywhere
    assert network.num_nodes.tolist() == [50] * 3
