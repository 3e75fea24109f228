"""GWR-B's graph, its saved state and its memory."""

import copy
import itertools
import sys

import pytest
import torch

from bgpo_trl.modules.gwr import GWRB
from tests.modules.gwr_networks import GROWING, assert_same_state, drifting_inputs, state_of

# ---- the graph


def test_edges_have_the_names_of_matches_and_the_positions_of_weights():
    gwr = GWRB(2, generator=torch.Generator().manual_seed(0), **GROWING)
    for phi in drifting_inputs(300, 2):
        gwr.adapt(phi)
    graph = gwr.graph()
    assert graph.node.tolist() != list(range(len(graph.node)))  # some were removed
    assert graph.edge_nodes.tolist() == [
        [int(graph.node[a]), int(graph.node[b])] for a, b in graph.edges
    ]
    for node, weights in zip(graph.node, graph.weights, strict=True):
        match = gwr.lookup(weights)
        assert match.node == node
        assert graph.edge_nodes.eq(match.node).any()  # no node is without an edge


def test_networkx_names_nodes_as_matches_do():
    gwr = GWRB(2, batch_size=[2], generator=torch.Generator().manual_seed(0), **GROWING)
    for phi in drifting_inputs(300, 2, 2):
        gwr.adapt(phi)
    graph = gwr.graph(1)
    copied = graph.to_networkx()
    assert [*copied.nodes] == graph.node.tolist() != list(range(len(copied)))
    ages = [copied.edges[edge]["age"] for edge in graph.edge_nodes.tolist()]
    assert ages == graph.ages.tolist()
    assert copied.number_of_edges() == len(ages)
    weights = {node: w.tolist() for node, w in copied.nodes(data="weights")}
    assert [*weights.values()] == graph.weights.tolist()
    habituation = [h for _, h in copied.nodes(data="habituation")]
    assert habituation == graph.habituation.tolist()
    point = graph.weights[3]
    match = gwr.lookup(torch.stack([point, point]))
    assert weights[int(match.node[1])] == point.tolist()
    copied.nodes[int(match.node[1])]["weights"][:] = 0  # is a copy
    assert torch.equal(gwr.graph(1).weights, graph.weights)
    assert len(GWRB(2, init="data").graph().to_networkx()) == 0


def test_without_networkx_one_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "networkx", None)
    with pytest.raises(ImportError, match=r"pip install 'bgpo_trl\[networkx\]'"):
        GWRB(2).graph().to_networkx()


# ---- state


def test_saved_state_continues_bit_for_bit(tmp_path):
    inputs = drifting_inputs(900, 2, 3, 4).float()
    masks = torch.rand(900, 2, 3, generator=torch.Generator().manual_seed(0)) < 0.6
    gwr = GWRB(4, batch_size=[2, 3], init="data", **GROWING)
    for phi, mask in zip(inputs[:300], masks[:300], strict=True):
        gwr.adapt(phi, mask)
    torch.save(gwr.state_dict(), tmp_path / "gwr.pt")
    resumed = GWRB(4, batch_size=[2, 3], **GROWING)
    resumed.load_state_dict(torch.load(tmp_path / "gwr.pt", weights_only=True))
    assert_same_state(state_of(resumed), state_of(gwr))
    for phi, mask in zip(inputs[300:], masks[300:], strict=True):
        mine, other = gwr.adapt(phi, mask), resumed.adapt(phi, mask)
        assert torch.equal(mine.node, other.node)
        assert torch.equal(mine.embedding[mask], other.embedding[mask])
    assert_same_state(state_of(resumed), state_of(gwr))
    identities = [gwr.graph(i).node for i in itertools.product(range(2), range(3))]
    assert any(node[-1] >= len(node) for node in identities)  # nodes were removed


def test_state_of_other_sizes_is_refused():
    gwr = GWRB(4, batch_size=[3])
    before = state_of(gwr)
    for other in (GWRB(4, batch_size=[2]), GWRB(5, batch_size=[3])):
        with pytest.raises(ValueError, match="same sizes"):
            gwr.load_state_dict(other.state_dict())
    assert_same_state(state_of(gwr), before)


def test_state_and_copies_are_snapshots():
    gwr = GWRB(4, **GROWING)
    state, graph, twin = gwr.state_dict(), gwr.graph(), copy.deepcopy(gwr)
    saved = copy.deepcopy(state)
    match = gwr.adapt(torch.ones(4))
    embedding = match.embedding.clone()
    for phi in drifting_inputs(100, 4):
        gwr.adapt(phi)
    assert_same_state(state["_extra_state"], saved["_extra_state"])
    assert_same_state(twin.state_dict()["_extra_state"], saved["_extra_state"])
    assert torch.equal(graph.weights, saved["_extra_state"][0]["weights"])
    assert torch.equal(match.embedding, embedding)
    match.embedding.zero_()
    assert twin.graph().weights.abs().min() > 0


def test_graph_is_indexed_like_the_batch():
    gwr = GWRB(2, batch_size=[2, 3])
    mask = torch.zeros(2, 3, dtype=torch.bool)
    mask[1, 2] = True
    gwr.adapt(torch.zeros(2, 3, 2), mask)
    ages = [[gwr.graph((i, j)).ages.item() for j in range(3)] for i in range(2)]
    assert ages == [[0, 0, 0], [0, 0, 1]]
    assert gwr.graph((-1, -1)).ages.item() == 1
    assert gwr.num_nodes.tolist() == [[2] * 3] * 2
    for wrong in ((2, 0), (), 1, (0, slice(2)), (0, 0, 0), 0.5):
        with pytest.raises(IndexError, match=r"^index must name one network"):
            gwr.graph(wrong)


def test_removed_nodes_cost_no_memory():
    gwr = GWRB(
        3, generator=torch.Generator().manual_seed(0), **{**GROWING, "max_age": 1, "max_nodes": 12}
    )
    for phi in drifting_inputs(2000, 3).float():
        gwr.adapt(phi)
    assert gwr.graph().node[-1] > 200  # so many nodes there were
    assert sum(buffer.numel() for buffer in gwr.buffers()) <= 50 * 3


def test_many_nodes_need_no_matrix_of_pairs():
    n = 40_000  # a float32 matrix of all pairs would take 6.4 GB
    row = torch.arange(n)
    state = {
        "weights": row.float().unsqueeze(-1),
        "habituation": torch.full((n,), 0.1, dtype=torch.float64),
        "edges": torch.stack([row[:-1], row[1:]], -1),
        "ages": torch.zeros(n - 1, dtype=torch.int64),
        "node": row,
        "next_node": n,
    }
    gwr = GWRB(1)
    gwr.load_state_dict({"_extra_state": [state]})
    assert gwr.adapt(torch.tensor([30_000.4])).node == 30_000
    graph = gwr.graph()
    assert graph.weights[-1].item() == pytest.approx(30_000.2)
    assert graph.edges[graph.edges[:, 1] == n].tolist() == [[30_000, n], [30_001, n]]
    assert len(graph.edges) == n
    assert int(graph.ages.sum()) == 2  # to 29,999 and to the new node


def test_what_grew_in_inference_mode_learns_on_outside():
    inside, outside = (GWRB(2, init="data", **GROWING) for _ in range(2))
    inputs = list(drifting_inputs(60, 2))
    with torch.inference_mode():
        for phi in inputs[:30]:
            inside.adapt(phi.clone())
    for phi in inputs[30:]:
        inside.adapt(phi)
    for phi in inputs:
        outside.adapt(phi)
    assert_same_state(state_of(inside), state_of(outside))


@pytest.mark.parametrize(
    "damage",
    [
        {"weights": None},
        {"weights": torch.zeros(2)},
        {"habituation": [1.0, 1.0]},
        {"edges": torch.tensor([[0.0, 1.0]])},
        {"edges": torch.tensor([0, 1])},
        {"ages": torch.zeros(1)},
        {"node": torch.tensor([0.0, 1.0])},
        {"next_node": None},
    ],
    ids=str,
)
def test_entries_of_another_kind_are_refused(damage):
    gwr = GWRB(1)
    (before,) = gwr.get_extra_state()
    with pytest.raises(ValueError, match=rf"damaged or not a graph .*\({next(iter(damage))}\)$"):
        gwr.set_extra_state([{**before, **damage}])
    assert_same_state(gwr.get_extra_state(), [before])


def test_fully_habituated_nodes_are_loaded():
    rule = {"alpha_best": 1.0, "alpha_neighbor": 1.0, "tau_best": 1e-3, "tau_neighbor": 1e-3}
    gwr, other = (GWRB(1, initial_habituation=1.0, **rule) for _ in range(2))
    gwr.adapt(torch.tensor([0.5]))
    (state,) = gwr.get_extra_state()
    assert state["habituation"].tolist() == [0.0, 0.0]
    other.load_state_dict(gwr.state_dict())
    assert_same_state(other.get_extra_state(), [state])
