"""The cost of GWR-B: what the benchmark measures, fits and writes."""

import json

import pytest
import torch

from benchmarks.speed import gwr


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
    printed = capsys.readouterr().out
    assert "| 1 | 40 |" in printed
    assert "| 2 | 30 |" in printed
    assert "exponent from 20 to 40 nodes" in printed


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_exponent_of_a_power_law_is_its_power(power):
    rows = [{"nodes": n, "call": {"median": 3 * n**power}} for n in (10, 70, 900)]
    assert gwr.slope(rows, "call") == pytest.approx(power)


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
