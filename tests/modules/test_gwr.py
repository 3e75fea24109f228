"""GWR-B against hand-computed numbers, a plain reference, and what must hold for any input."""

import copy
import itertools
import math
import sys
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.modules.gwr import GWRB

GROWING: dict[str, Any] = {"activity_threshold": 0.9, "habituation_threshold": 0.6, "max_age": 2}
ALWAYS_INSERT: dict[str, Any] = {"activity_threshold": 1.0, "habituation_threshold": 2.0}


class Reference:
    """One network with dictionaries, math.dist and the closed forms of Eqs. 5 and 6."""

    def __init__(
        self,
        weights,
        activity_threshold=0.8,
        habituation_threshold=0.15,
        lr_best=0.1,
        lr_neighbor=0.01,
        alpha=1.05,
        tau_best=3.3,
        tau_neighbor=14.3,
        max_age=80,
        max_nodes=math.inf,
    ):
        self.weights = dict(enumerate(weights))
        self.fired = {node: [0, 0] for node in self.weights}  # as the best match, as a neighbor
        self.edges = {frozenset((0, 1)): 0} if len(weights) == 2 else {}
        self.created, self.removed = len(weights), 0
        self.a_t, self.h_t = activity_threshold, habituation_threshold
        self.lr_best, self.lr_neighbor = lr_best, lr_neighbor
        self.alpha, self.tau = alpha, (tau_best, tau_neighbor)
        self.max_age, self.max_nodes = max_age, max_nodes

    def habituation(self, node):
        exponent = sum(
            self.alpha * n / tau for n, tau in zip(self.fired[node], self.tau, strict=True)
        )
        return 1 - (1 - math.exp(-exponent)) / self.alpha

    def create(self, weights):
        node = self.created
        self.weights[node], self.fired[node] = weights, [0, 0]
        self.created += 1
        return node

    def adapt(self, phi):
        if not self.weights:
            return self.create(phi), phi, 1.0
        ranked = sorted(self.weights, key=lambda node: (math.dist(phi, self.weights[node]), node))
        c, matched = ranked[0], self.weights[ranked[0]]
        activity = math.exp(-math.dist(phi, matched))
        if len(ranked) == 1:
            self.edges[frozenset((c, self.create(phi)))] = 0
            return c, matched, activity
        second = ranked[1]
        self.edges[frozenset((c, second))] = 0
        grows = len(self.weights) < self.max_nodes
        if activity < self.a_t and self.habituation(c) < self.h_t and grows:
            v = self.create([(w + x) / 2 for w, x in zip(matched, phi, strict=True)])
            del self.edges[frozenset((c, second))]
            self.edges[frozenset((v, c))] = self.edges[frozenset((v, second))] = 0
        else:
            near = {node for edge in self.edges if c in edge for node in edge}
            for node in near:
                rate = self.habituation(node) * (self.lr_best if node == c else self.lr_neighbor)
                self.weights[node] = [
                    w + rate * (x - w) for w, x in zip(self.weights[node], phi, strict=True)
                ]
            for node in near:
                self.fired[node][node != c] += 1
        self.edges = {edge: age + (c in edge) for edge, age in self.edges.items()}
        self.edges = {edge: age for edge, age in self.edges.items() if age <= self.max_age}
        for node in set(self.weights) - set().union(*self.edges):
            del self.weights[node], self.fired[node]
            self.removed += 1
        return c, matched, activity


def assert_same_network(graph, reference, **tolerance):
    nodes = sorted(reference.weights)
    assert graph.node.tolist() == nodes
    position = {node: i for i, node in enumerate(nodes)}
    edges = {tuple(sorted(position[n] for n in edge)): a for edge, a in reference.edges.items()}
    assert [tuple(edge) for edge in graph.edges.tolist()] == sorted(edges)
    assert graph.ages.tolist() == [edges[edge] for edge in sorted(edges)]
    weights = torch.tensor([reference.weights[node] for node in nodes], dtype=graph.weights.dtype)
    torch.testing.assert_close(graph.weights, weights, **tolerance)
    habituation = torch.tensor([reference.habituation(n) for n in nodes], dtype=torch.float64)
    torch.testing.assert_close(graph.habituation, habituation, rtol=1e-9, atol=0)


def drifting_inputs(n, *shape, seed=0):
    """Noisy random walk, so that nodes fall out of use and are removed; float64 [n, *shape]."""
    generator = torch.Generator().manual_seed(seed)
    walk, noise = torch.randn(2, n, *shape, generator=generator, dtype=torch.float64)
    return (0.1 * walk).cumsum(0).tanh() + 0.05 * noise


def state_of(gwr):
    """All tensors and counters of a GWRB, by name."""
    return {
        f"{i}.{name}": value
        for i, network in enumerate(gwr.state_dict()["_extra_state"])
        for name, value in network.items()
    }


def assert_same_state(a, b):
    torch.testing.assert_close(a, b, rtol=0, atol=0)


def from_data(weights, **kwargs):
    """A network whose first two nodes have these weights."""
    gwr = GWRB(len(weights[0]), init="data", **kwargs)
    for phi in weights:
        gwr.adapt(torch.tensor(phi))
    return gwr


# ---- the plain reference, node for node


@pytest.mark.parametrize(
    "rule",
    [
        {},
        GROWING,
        {**GROWING, "max_age": 1, "max_nodes": 12},
        {**GROWING, "tau_neighbor": 2.0, "lr_best": 0.5},
    ],
    ids=["table 1", "growing", "capped", "fast"],
)
@pytest.mark.parametrize("init", ["random", "data"])
def test_masked_batch_follows_the_plain_reference(rule, init):
    generator = torch.Generator().manual_seed(0)
    gwr = GWRB(3, batch_size=[2, 2], init=init, generator=generator, **rule).double()
    indices = list(itertools.product(range(2), range(2)))
    references = {i: Reference(gwr.graph(i).weights.tolist(), **rule) for i in indices}
    found, expected = [], []
    for phi in drifting_inputs(500, 2, 2, 3):
        mask = torch.rand(2, 2, generator=generator) < 0.7
        match = gwr.adapt(phi.where(mask.unsqueeze(-1), torch.nan), mask)
        for i in indices:
            matched = (math.nan,) * 3, -1, math.nan
            if mask[i]:
                node, embedding, activity = references[i].adapt(phi[i].tolist())
                matched = embedding, node, activity
            expected.append([*matched[0], *matched[1:]])
            found.append(
                [*match.embedding[i].tolist(), match.node[i].item(), match.activity[i].item()]
            )
    torch.testing.assert_close(
        torch.tensor(found, dtype=torch.float64),
        torch.tensor(expected, dtype=torch.float64),
        rtol=1e-9,
        atol=1e-12,
        equal_nan=True,
    )
    for i, reference in references.items():
        assert_same_network(gwr.graph(i), reference, rtol=1e-9, atol=1e-12)
        assert gwr.num_nodes[i] == len(reference.weights)
    if rule:  # the test would say little if neither had happened
        assert min(reference.created for reference in references.values()) > 12
        assert sum(reference.removed for reference in references.values()) > 15


def test_single_precision_follows_the_plain_reference():
    gwr = GWRB(8, generator=torch.Generator().manual_seed(1), **GROWING)
    reference = Reference(gwr.graph().weights.tolist(), **GROWING)
    for phi in drifting_inputs(1000, 8).float():
        assert gwr.adapt(phi).node == reference.adapt(phi.tolist())[0]
    assert reference.removed > 50
    assert_same_network(gwr.graph(), reference, rtol=1e-4, atol=1e-4)


# ---- the equations, by hand


def test_match_is_the_nearest_node_and_its_activity():
    gwr = from_data([[0.0, 0.0], [3.0, 4.0]])
    match = gwr.lookup(torch.tensor([[3.0, 3.5], [0.0, 0.25]]))
    assert match.node.tolist() == [1, 0]
    assert match.embedding.tolist() == [[3.0, 4.0], [0.0, 0.0]]
    assert match.activity.tolist() == pytest.approx([0.6065307, 0.7788008])  # exp(-.5), exp(-.25)


def test_activity_decays_with_the_scaled_distance():
    gwr = from_data([[0.0, 0.0], [3.0, 4.0]], activity_scale=2.0)
    assert gwr.lookup(torch.tensor([3.0, 3.5])).activity.item() == pytest.approx(math.exp(-1))
    assert gwr.adapt(torch.tensor([0.0, 0.25])).activity.item() == pytest.approx(math.exp(-0.5))


@pytest.mark.parametrize("scale", [0.25, 4.0])  # powers of two: nothing is rounded otherwise
def test_scaled_activity_is_that_of_scaled_inputs(scale):
    scaled, plain = (
        GWRB(3, batch_size=[2], init="data", activity_scale=s, **GROWING).double()
        for s in (scale, 1.0)
    )
    inputs = drifting_inputs(500, 2, 3) * 0.5 / scale
    for phi in inputs:
        match, expected = scaled.adapt(phi), plain.adapt(scale * phi)
        assert torch.equal(match.activity, expected.activity)
        assert torch.equal(match.node, expected.node)
        assert torch.equal(scale * match.embedding, expected.embedding)
    for i in range(2):
        graph, expected = scaled.graph(i), plain.graph(i)
        torch.testing.assert_close(
            graph._replace(weights=scale * graph.weights), expected, rtol=0, atol=0
        )
        assert graph.node[-1] > len(graph.node) > 5  # nodes were inserted, and some removed
    unscaled = GWRB(3, batch_size=[2], init="data", **GROWING).double()
    for phi in inputs:
        unscaled.adapt(phi)
    assert not torch.equal(unscaled.num_nodes, plain.num_nodes)  # the scale did matter


def test_best_match_and_neighbor_learn_and_habituate():
    gwr = from_data([[0.0, 0.0], [1.0, 0.0]])
    match = gwr.adapt(torch.tensor([0.25, 0.5]))
    assert match.embedding.tolist() == [0.0, 0.0]  # from before learning
    graph = gwr.graph()
    assert graph.weights.tolist() == [
        pytest.approx([0.1 * 0.25, 0.1 * 0.5]),
        pytest.approx([1 - 0.01 * 0.75, 0.01 * 0.5]),
    ]
    assert graph.habituation.tolist() == pytest.approx([0.7404474, 0.9325757])
    gwr.adapt(torch.tensor([0.25, 0.5]))
    step = 0.1 * 0.7404474 * (0.25 - 0.025)
    assert gwr.graph().weights[0, 0].item() == pytest.approx(0.025 + step)


def test_habituation_counts_the_firings_of_the_node_itself():
    gwr = from_data([[0.0], [1.0]], activity_threshold=0.0)
    for _ in range(5):
        gwr.adapt(torch.tensor([0.0]))
    for _ in range(2):
        gwr.adapt(torch.tensor([1.0]))
    expected = [
        1 - (1 - math.exp(-1.05 * x)) / 1.05 for x in (5 / 3.3 + 2 / 14.3, 5 / 14.3 + 2 / 3.3)
    ]
    assert gwr.graph().habituation.tolist() == pytest.approx(expected, rel=1e-12)


def test_best_match_and_neighbor_have_constants_of_their_own():
    gwr = from_data(
        [[0.0], [1.0]], initial_habituation=0.5, alpha_best=2.0, alpha_neighbor=4.0,
        tau_best=2.0, tau_neighbor=4.0, lr_best=0.4, lr_neighbor=0.2,
    )  # fmt: skip
    gwr.adapt(torch.tensor([0.5]))
    # h_inf = 0 and 1/4; what is left of h - h_inf is exp(-1) for both
    graph = gwr.graph()
    assert graph.habituation.tolist() == pytest.approx(
        [0.5 * math.exp(-1), 0.25 + 0.25 * math.exp(-1)]
    )
    assert graph.weights.flatten().tolist() == pytest.approx([0.4 * 0.5 * 0.5, 1 - 0.2 * 0.5 * 0.5])


def test_novel_input_inserts_a_node_once_the_best_match_is_habituated():
    gwr = from_data([[0.0], [-9.0]])
    # h_n = 1 - (1 - exp(-1.05 n / 3.3)) / 1.05 is .15028 for n = 7 and .12224 for n = 8
    counts = [int((gwr.adapt(torch.tensor([5.0])), gwr.num_nodes)[1]) for _ in range(9)]
    assert counts == [2] * 8 + [3]


def test_inserted_node_lies_between_and_takes_over_the_edge():
    gwr = from_data([[0.0, 0.0], [1.0, 0.0]], **ALWAYS_INSERT)
    gwr.adapt(torch.tensor([0.25, 0.5]))
    graph = gwr.graph()
    assert graph.weights.tolist() == [[0.0, 0.0], [1.0, 0.0], [0.125, 0.25]]
    assert graph.habituation.tolist() == [1.0, 1.0, 1.0]
    assert graph.edges.tolist() == [[0, 2], [1, 2]]
    assert graph.ages.tolist() == [1, 0]  # only the edge of the best match has aged


def test_familiar_input_inserts_nothing():
    gwr = from_data([[0.0], [1.0]], **ALWAYS_INSERT)
    gwr.adapt(torch.tensor([0.0]))  # activity is 1, not below the threshold 1
    assert gwr.num_nodes == 2


def test_full_network_adapts_instead_of_inserting():
    gwr = from_data([[0.0], [1.0]], max_nodes=2, **ALWAYS_INSERT)
    gwr.adapt(torch.tensor([0.5]))
    assert gwr.graph().weights.flatten().tolist() == pytest.approx([0.05, 0.995])


def test_edges_age_at_the_best_match_and_expire_with_their_nodes():
    gwr = from_data([[0.0], [1.0]], max_age=2, lr_neighbor=0.0, **ALWAYS_INSERT)
    gwr.adapt(torch.tensor([4.0]))  # best 1, second 0: node 2 at 2.5; edges 1-2 (1), 0-2 (0)
    for phi in (1.0, 1.0):  # familiar; best 1, second 0: edge 0-1 renewed, then edge 1-2 ages
        gwr.adapt(torch.tensor([phi]))
    graph = gwr.graph()
    assert graph.edges.tolist() == [[0, 1], [0, 2]]  # 1-2 had age 3
    assert graph.ages.tolist() == [1, 0]
    for _ in range(3):  # best 0, second 1: edge 0-2 ages to 3, node 2 has no other
        assert gwr.num_nodes == 3
        gwr.adapt(torch.tensor([0.0]))
    assert gwr.graph().node.tolist() == [0, 1]
    gwr.adapt(torch.tensor([-4.0]))
    assert gwr.graph().node.tolist() == [0, 1, 3]  # the identity 2 is not used again


def test_ties_go_to_the_older_node():
    ties = from_data([[1.0, 0.0], [-1.0, 0.0]])
    assert ties.adapt(torch.tensor([0.0, 0.5])).node == 0
    copies = from_data([[2.0], [2.0]], max_age=1, **ALWAYS_INSERT)
    copies.adapt(torch.tensor([2.0]))
    copies.adapt(torch.tensor([4.0]))  # node 2 at 3
    copies.adapt(torch.tensor([1.0]))  # nodes 0 and 1 are as near: 0 is best, 1 second
    assert copies.graph().weights.flatten().tolist() == [2.0, 2.0, 3.0, 1.5]
    assert copies.graph().edges.tolist() == [[0, 3], [1, 2], [1, 3]]


def test_no_gradient_flows_through_a_match():
    gwr = GWRB(2)
    phi = torch.zeros(2, requires_grad=True)
    for match in (gwr.lookup(phi), gwr.adapt(phi)):
        assert not match.embedding.requires_grad
        assert not match.activity.requires_grad


# ---- starting


def test_first_two_inputs_become_the_nodes():
    gwr = GWRB(2, init="data")
    assert gwr.num_nodes == 0
    with pytest.raises(ValueError, match="empty"):
        gwr.lookup(torch.zeros(2))
    first, second = torch.tensor([0.5, 0.0]), torch.tensor([0.5, 1.0])
    match = gwr.adapt(first)
    assert (match.embedding.tolist(), match.node, match.activity) == ([0.5, 0.0], 0, 1.0)
    assert gwr.graph().edges.shape == (0, 2)
    match = gwr.adapt(second)  # is matched with what there was before
    assert match.node == 0
    assert match.activity.item() == pytest.approx(math.exp(-1))
    assert gwr.graph().weights.tolist() == [[0.5, 0.0], [0.5, 1.0]]
    assert (gwr.graph().edges.tolist(), gwr.graph().ages.tolist()) == ([[0, 1]], [0])


def test_random_start_is_two_connected_nodes_within_the_range_of_phi():
    graph = GWRB(500, generator=torch.Generator().manual_seed(0)).graph()
    assert graph.edges.tolist() == [[0, 1]]
    assert graph.habituation.tolist() == [1.0, 1.0]
    assert -1 <= graph.weights.min() < -0.95 < 0.95 < graph.weights.max() < 1
    assert abs(graph.weights.mean()) < 0.1


def test_redrawn_networks_are_as_if_constructed_so():
    def generators():
        return [torch.Generator().manual_seed(seed) for seed in (5, 6)]

    gwr, fresh = GWRB(3, batch_size=2), GWRB(3, batch_size=2, generator=generators())
    gwr.redraw(generators())
    phi = torch.rand(2, 3, generator=torch.Generator().manual_seed(0))
    for _ in range(2):
        for network in range(2):
            assert gwr.graph(network).weights.equal(fresh.graph(network).weights)
            assert gwr.graph(network).ages.equal(fresh.graph(network).ages)
        gwr.adapt(phi)
        fresh.adapt(phi)


@pytest.mark.parametrize("init", ["random", "data"])
def test_networks_that_have_learned_are_not_redrawn(init):
    gwr = GWRB(3, batch_size=2, init=init)
    for phi in (torch.zeros(2, 3), torch.ones(2, 3)):
        gwr.adapt(phi, mask=torch.tensor([True, False]))
    resumed = GWRB(3, batch_size=2, init=init)
    resumed.load_state_dict(gwr.state_dict())
    for network in (gwr, resumed):
        before = [network.graph(i).weights for i in range(2)]
        network.redraw(torch.Generator().manual_seed(1))
        assert network.graph(0).weights.equal(before[0])
        assert network.graph(1).weights.equal(before[1]) == (init == "data")


def test_redrawing_takes_a_generator_for_each_network():
    gwr = GWRB(3, batch_size=2)
    with pytest.raises(ValueError, match=r"torch\.Generator, or a sequence of 2, one a network"):
        gwr.redraw([torch.Generator()])


def test_network_of_a_batch_is_what_its_seed_is_alone():
    inputs = drifting_inputs(300, 3, 4)
    generators = [torch.Generator().manual_seed(seed) for seed in range(3)]
    batch = GWRB(4, batch_size=[3], generator=generators, **GROWING).double()
    alone = [
        GWRB(4, generator=torch.Generator().manual_seed(seed), **GROWING).double()
        for seed in range(3)
    ]
    for phi in inputs:
        match = batch.adapt(phi)
        for i, gwr in enumerate(alone):
            torch.testing.assert_close(gwr.adapt(phi[i]), match[i])
    for i, gwr in enumerate(alone):
        torch.testing.assert_close(gwr.graph(), batch.graph(i))
    assert len({int(n) for n in batch.num_nodes}) > 1


# ---- what people bring along


@pytest.mark.parametrize(
    "kind",
    [
        lambda phi: phi.float(),
        lambda phi: phi.numpy(),
        lambda phi: phi.numpy().astype(np.float32),
        lambda phi: phi.tolist(),
        lambda phi: list(phi),
        lambda phi: phi.numpy()[..., ::-1].copy()[..., ::-1],  # of negative strides
        lambda phi: np.broadcast_to(phi.numpy(), phi.shape),  # read-only
    ],
    ids=["float32", "numpy", "numpy32", "lists", "list of tensors", "strides", "read-only"],
)
@pytest.mark.parametrize("batch_size", [(), 2])
@pytest.mark.filterwarnings("error")
def test_inputs_of_any_kind_are_the_same_inputs(kind, batch_size):
    inputs = drifting_inputs(60, *torch.Size([2][: batch_size != ()]), 3)
    one, other = (GWRB(3, batch_size=batch_size, init="data", **GROWING) for _ in range(2))
    for phi in inputs:
        assert_same_state(one.adapt(kind(phi)), other.adapt(phi))
    assert_same_state(state_of(one), state_of(other))
    assert one.num_nodes.min() > 2
    many = inputs.movedim(0, -2)
    assert_same_state(one.lookup(kind(many)), other.lookup(many))


def test_integers_and_a_mask_of_any_kind_are_taken():
    gwr = GWRB(2, batch_size=np.int64(2), init="data")
    assert gwr.batch_size == (2,)
    for mask in ([True, False], np.array([True, False])):
        gwr.adapt([[1, 2], [3, 4]], mask)
    assert gwr.num_nodes.tolist() == [2, 0]
    assert gwr.graph(0).weights.tolist() == [[1.0, 2.0], [1.0, 2.0]]
    alone = GWRB(np.int64(1))
    assert alone.adapt(np.array([2], np.int32), mask=False).node == -1


@pytest.mark.parametrize(
    "wrong", [[[1, 2], [3]], object(), "ab", [["a", "b"], ["c", "d"]], np.ones((2, 2), complex)]
)
def test_what_is_no_input_is_refused_by_name(wrong):
    gwr = GWRB(2, batch_size=2)
    before = state_of(gwr)
    for call in (gwr.lookup, gwr.adapt, lambda phi: gwr.adapt([[0, 0], [0, 0]], mask=phi)):
        with pytest.raises(ValueError, match=r"^(phi|mask) must be") as raised:
            call(wrong)
        assert "\n" not in str(raised.value)
    assert_same_state(state_of(gwr), before)


def test_repr_tells_nodes_and_thresholds():
    gwr = GWRB(2, batch_size=2, init="data", activity_threshold=0.7, activity_scale=3.0)
    gwr.adapt([[0, 0], [0, 0]])
    gwr.adapt([[0, 0], [1, 0]], [True, False])
    assert repr(gwr) == (
        "GWRB(2, batch_size=[2], num_nodes=1 to 2, activity_threshold=0.7, activity_scale=3.0, "
        "habituation_threshold=0.15)"
    )
    assert "num_nodes=2, " in repr(GWRB(5, batch_size=[3]))


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


# ---- refusals


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 3e38])
def test_what_cannot_be_matched_is_refused_before_any_network_changes(bad):
    gwr = GWRB(2, batch_size=[3], init="data", **GROWING)
    mask = torch.tensor([True, False, True])
    for phi in drifting_inputs(30, 3, 2).float():
        gwr.adapt(phi, mask)  # leaves network 1 empty
    before = state_of(gwr)
    phi = torch.zeros(3, 2)
    phi[2, 1] = bad
    with pytest.raises(ValueError, match="NaN, Inf"):
        gwr.adapt(phi)
    with pytest.raises(ValueError, match="NaN, Inf"):
        gwr.adapt(phi, mask)
    assert_same_state(state_of(gwr), before)
    gwr.adapt(phi, ~mask)
    with pytest.raises(ValueError, match="NaN, Inf"):
        gwr.lookup(phi)


def test_wrong_shapes_are_refused():
    gwr = GWRB(4, batch_size=[3])
    for phi in (torch.zeros(4), torch.zeros(3, 5), torch.zeros(2, 4), torch.tensor(0.0)):
        with pytest.raises(ValueError, match="phi must"):
            gwr.lookup(phi)
        with pytest.raises(ValueError, match="phi must"):
            gwr.adapt(phi)
    with pytest.raises(ValueError, match="phi must"):
        gwr.adapt(torch.zeros(3, 2, 4))
    for mask in (torch.ones(3, 1, dtype=torch.bool), torch.ones(3)):
        with pytest.raises(ValueError, match="mask must be bool"):
            gwr.adapt(torch.zeros(3, 4), mask)


@pytest.mark.parametrize(
    "wrong",
    [
        {"activity_scale": 0.0},
        {"activity_scale": -1.0},
        {"activity_scale": math.nan},
        {"activity_scale": math.inf},
        {"lr_best": 1.5},
        {"lr_neighbor": 0.2},
        {"lr_neighbor": -0.1},
        {"initial_habituation": 0.0},
        {"alpha_best": 0.9},
        {"alpha_neighbor": 0.9},
        {"tau_best": 0.0},
        {"tau_neighbor": -1.0},
        {"max_age": 0},
        {"max_nodes": 1},
        {"init": "zeros"},
        {"batch_size": [0]},
        {"batch_size": 0},
        {"batch_size": 2.5},
        {"batch_size": "2"},
        {"lr_best": "fast"},
        {"max_age": None},
        {"activity_threshold": torch.tensor(0.8)},
        {"generator": 0},
        {"batch_size": [3], "generator": [torch.Generator()]},
    ],
)
def test_arguments_out_of_range_are_refused(wrong):
    name = next(reversed(wrong)) if "init" not in wrong else "init"
    with pytest.raises(ValueError, match=name) as raised:
        GWRB(4, **wrong)
    assert "\n" not in str(raised.value)
    others = {"tau_best", "tau_neighbor", "max_age", "max_nodes"} - {name}
    assert not any(other in str(raised.value) for other in others)


@pytest.mark.parametrize("wrong", [0, 2.5, "2", None, [2]])
def test_a_number_of_features_is_a_whole_number(wrong):
    with pytest.raises(ValueError, match="n_features"):
        GWRB(wrong)


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


# ---- what must hold for any input

# On so coarse a grid inputs repeat and distances tie.
coordinate = st.integers(-4, 4).map(lambda x: x / 4)
sequences = st.lists(st.tuples(*[coordinate] * 4), min_size=3, max_size=40).map(
    lambda inputs: torch.tensor(inputs).view(-1, 2, 2)  # two networks of two features
)
rules = st.fixed_dictionaries(
    {
        "activity_threshold": st.floats(0, 1),
        "habituation_threshold": st.floats(0, 2),
        "lr_best": st.floats(0.1, 1),
        "lr_neighbor": st.floats(0, 0.1),
        "max_age": st.integers(1, 5),
        "max_nodes": st.none() | st.integers(2, 8),
        "init": st.sampled_from(["random", "data"]),
    }
)
examples = settings(max_examples=25, deadline=None)


def new(rule, seed=0, batch_size=(2,)):
    return GWRB(2, batch_size=batch_size, generator=torch.Generator().manual_seed(seed), **rule)


@examples
@given(inputs=sequences, rule=rules)
def test_graph_stays_sound(inputs, rule):
    gwr = new(rule)
    start = torch.cat([gwr.graph(i).weights.view(-1, 2) for i in range(2)])
    seen = torch.cat([start, inputs.view(-1, 2)])
    for phi in inputs:
        gwr.adapt(phi)
        for i in range(2):
            graph = gwr.graph(i)
            n = len(graph.weights)
            assert n == len(graph.habituation) == len(graph.node) == gwr.num_nodes[i]
            assert graph.node.tolist() == sorted(set(graph.node.tolist()))
            assert n <= (rule["max_nodes"] or n)
            pairs = [tuple(edge) for edge in graph.edges.tolist()]
            assert len(pairs) == len(set(pairs)) == len(graph.ages)
            assert all(0 <= a < b < n for a, b in pairs)  # neither loops nor both directions
            if n >= 2:
                assert set(itertools.chain(*pairs)) == set(range(n))
            assert all(0 <= age <= rule["max_age"] for age in graph.ages.tolist())
            assert graph.habituation.min() >= 1 - 1 / 1.05
            assert graph.habituation.max() <= 1
            assert (graph.weights >= seen.amin(0) - 1e-6).all()
            assert (graph.weights <= seen.amax(0) + 1e-6).all()


@examples
@given(inputs=sequences, rule=rules)
def test_lookup_is_pure_and_says_what_adapt_will(inputs, rule):
    gwr = new(rule)
    gwr.adapt(inputs[0])
    for phi in inputs[1:]:
        before = state_of(gwr)
        match = gwr.lookup(phi)
        assert_same_state(state_of(gwr), before)
        many = gwr.lookup(inputs.movedim(0, 1))
        assert many.batch_size == (2, len(inputs))
        for i in range(2):
            graph = gwr.graph(i)
            row = (graph.node == match.node[i]).nonzero().item()
            assert torch.equal(match.embedding[i], graph.weights[row])
            assert torch.equal(
                many.embedding[i], graph.weights[torch.searchsorted(graph.node, many.node[i])]
            )
        torch.testing.assert_close(gwr.adapt(phi), match, rtol=0, atol=0)


@examples
@given(inputs=sequences, rule=rules, data=st.data())
def test_networks_left_out_keep_their_state(inputs, rule, data):
    gwr = new(rule)
    masks = data.draw(
        st.lists(
            st.tuples(st.booleans(), st.booleans()), min_size=len(inputs), max_size=len(inputs)
        )
    )
    for phi, chosen in zip(inputs, masks, strict=True):
        before = state_of(gwr)
        mask = torch.tensor(chosen)
        match = gwr.adapt(phi.where(mask.unsqueeze(-1), torch.nan), mask)
        after = state_of(gwr)
        for i in range(2):
            left_out = {k: v for k, v in before.items() if k.startswith(f"{i}.")}
            if not chosen[i]:
                assert_same_state({k: after[k] for k in left_out}, left_out)
                assert match.node[i] == -1


@examples
@given(inputs=sequences, rule=rules)
def test_networks_share_nothing_but_the_batch(inputs, rule):
    gwr, swapped = new(rule), new(rule)
    state = gwr.state_dict()
    state["_extra_state"].reverse()
    swapped.load_state_dict(state)
    for phi in inputs:
        match, other = gwr.adapt(phi), swapped.adapt(phi.flip(0))
        torch.testing.assert_close(other.flip(0), match, rtol=0, atol=0)
    for i in range(2):
        torch.testing.assert_close(swapped.graph(1 - i), gwr.graph(i), rtol=0, atol=0)
