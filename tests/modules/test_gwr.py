"""GWR-B against a plain reference and hand-computed numbers; its state, and inputs of all kinds."""

import copy
import itertools
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.modules.gwr import GWRB

TABLE_1 = GWRBConfig()
GROWING = GWRBConfig(activity_threshold=0.9, habituation_threshold=0.6, max_age=2)
ALWAYS_INSERT = GWRBConfig(activity_threshold=1.0, habituation_threshold=2.0)


class Reference:
    """One network with dictionaries, math.dist and the closed forms of Eqs. 5 and 6."""

    def __init__(self, weights, config, max_nodes=None):
        self.weights = dict(enumerate(weights))
        self.fired = {node: [0, 0] for node in self.weights}  # as the best match, as a neighbor
        self.edges = {frozenset((0, 1)): 0} if len(weights) == 2 else {}
        self.created, self.removed = len(weights), 0
        self.config, self.max_nodes = config, max_nodes or math.inf

    def habituation(self, node):
        (as_best, as_neighbor), alpha = self.fired[node], self.config.alpha_best  # one alpha
        exponent = as_best / self.config.tau_best + as_neighbor / self.config.tau_neighbor
        return 1 - (1 - math.exp(-alpha * exponent)) / alpha

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
        activity = math.exp(-self.config.activity_scale * math.dist(phi, matched))
        if len(ranked) == 1:
            self.edges[frozenset((c, self.create(phi)))] = 0
            return c, matched, activity
        second = ranked[1]
        self.edges[frozenset((c, second))] = 0
        if (
            activity < self.config.activity_threshold
            and self.habituation(c) < self.config.habituation_threshold
            and len(self.weights) < self.max_nodes
        ):
            v = self.create([(w + x) / 2 for w, x in zip(matched, phi, strict=True)])
            del self.edges[frozenset((c, second))]
            self.edges[frozenset((v, c))] = self.edges[frozenset((v, second))] = 0
        else:
            near = {node for edge in self.edges if c in edge for node in edge}
            for node in near:
                lr = self.config.lr_best if node == c else self.config.lr_neighbor
                rate = lr * self.habituation(node)
                self.weights[node] = [
                    w + rate * (x - w) for w, x in zip(self.weights[node], phi, strict=True)
                ]
            for node in near:
                self.fired[node][node != c] += 1
        self.edges = {edge: age + (c in edge) for edge, age in self.edges.items()}
        self.edges = {edge: age for edge, age in self.edges.items() if age <= self.config.max_age}
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


def drifting_inputs(n, *shape):
    """Noisy random walk, so that nodes fall out of use and are removed; float64 [n, *shape]."""
    generator = torch.Generator().manual_seed(0)
    walk, noise = torch.randn(2, n, *shape, generator=generator, dtype=torch.float64)
    return (0.1 * walk).cumsum(0).tanh() + 0.05 * noise


def grown(*shape):
    """Networks that have inserted and removed nodes."""
    generator = torch.Generator().manual_seed(0)
    gwr = GWRB(shape[-1], GROWING, batch_size=shape[:-1], generator=generator)
    for phi in drifting_inputs(300, *shape):
        gwr.adapt(phi)
    return gwr


def from_data(weights, config=TABLE_1, **options):
    """A network whose first two nodes have these weights."""
    gwr = GWRB(len(weights[0]), config, init="data", **options)
    for phi in weights:
        gwr.adapt(torch.tensor(phi))
    return gwr


def assert_same(a, b):
    torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


# ---- the plain reference, node for node


@pytest.mark.parametrize(
    ("config", "max_nodes"),
    [
        (TABLE_1, None),
        (GROWING, None),
        (replace(GROWING, max_age=1), 12),
        (replace(GROWING, tau_neighbor=2.0, lr_best=0.5), None),
        (replace(GROWING, activity_scale=4.0), None),
    ],
    ids=["table 1", "growing", "capped", "fast", "scaled"],
)
@pytest.mark.parametrize("init", ["random", "data"])
def test_masked_batch_follows_the_plain_reference(config, max_nodes, init):
    generator = torch.Generator().manual_seed(0)
    options = {"max_nodes": max_nodes, "init": init, "generator": generator}
    gwr = GWRB(3, config, batch_size=[2, 2], **options).double()
    indices = list(itertools.product(range(2), range(2)))
    references = {i: Reference(gwr.graph(i).weights.tolist(), config, max_nodes) for i in indices}
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
    if config != TABLE_1:  # nodes were inserted and removed
        assert min(reference.created for reference in references.values()) > 12
        assert sum(reference.removed for reference in references.values()) > 15


# ---- the equations, by hand


def test_best_match_and_neighbor_have_constants_of_their_own():
    config = GWRBConfig(
        initial_habituation=0.5, alpha_best=2.0, alpha_neighbor=4.0, tau_best=2.0, tau_neighbor=4.0,
        lr_best=0.4, lr_neighbor=0.2,
    )  # fmt: skip
    gwr = from_data([[0.0], [1.0]], config)
    gwr.adapt(torch.tensor([0.5]))
    # h_inf = 0 and 1/4; what is left of h - h_inf is exp(-1) for both
    graph = gwr.graph()
    assert graph.habituation.tolist() == pytest.approx(
        [0.5 * math.exp(-1), 0.25 + 0.25 * math.exp(-1)]
    )
    assert graph.weights.flatten().tolist() == pytest.approx([0.4 * 0.5 * 0.5, 1 - 0.2 * 0.5 * 0.5])


def test_ties_go_to_the_older_node():
    ties = from_data([[1.0, 0.0], [-1.0, 0.0]])
    assert ties.adapt(torch.tensor([0.0, 0.5])).node == 0
    copies = from_data([[2.0], [2.0]], replace(ALWAYS_INSERT, max_age=1))
    copies.adapt(torch.tensor([2.0]))
    copies.adapt(torch.tensor([4.0]))  # node 2 at 3
    copies.adapt(torch.tensor([1.0]))  # nodes 0 and 1 are as near: 0 is best, 1 second
    assert copies.graph().weights.flatten().tolist() == [2.0, 2.0, 3.0, 1.5]
    assert copies.graph().edges.tolist() == [[0, 3], [1, 2], [1, 3]]


# ---- graph and state


def test_graph_names_nodes_by_identity_and_edges_by_position():
    gwr = grown(2, 2)
    graph = gwr.graph(1)
    assert graph.node.tolist() != list(range(len(graph.node)))  # some were removed
    copied = graph.to_networkx()
    assert [*copied.nodes] == graph.node.tolist()
    positions = [[int(graph.node[a]), int(graph.node[b])] for a, b in graph.edges]
    assert graph.edge_nodes.tolist() == positions
    assert [copied.edges[edge]["age"] for edge in positions] == graph.ages.tolist()
    assert copied.number_of_edges() == len(positions)
    assert [h for _, h in copied.nodes(data="habituation")] == graph.habituation.tolist()
    found = gwr.lookup(graph.weights.expand(2, -1, -1)).node[1]
    assert found.equal(graph.node)
    for node, weights in zip(found.tolist(), graph.weights, strict=True):
        assert copied.nodes[node]["weights"].tolist() == weights.tolist()
        copied.nodes[node]["weights"][:] = 0
    assert torch.equal(gwr.graph(1).weights, graph.weights)  # which is a copy
    assert len(GWRB(2, init="data").graph().to_networkx()) == 0


def test_to_networkx_without_networkx_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "networkx", None)
    with pytest.raises(ImportError, match=r"pip install 'bgpo_trl\[networkx\]'"):
        GWRB(2).graph().to_networkx()


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
        with pytest.raises(IndexError):
            gwr.graph(wrong)


def test_graphs_states_matches_and_copies_do_not_change_when_the_network_learns():
    gwr = GWRB(4, GROWING)
    state, graph, twin = gwr.state_dict(), gwr.graph(), copy.deepcopy(gwr)
    saved = copy.deepcopy(state)
    match = gwr.adapt(torch.ones(4))
    embedding = match.embedding.clone()
    for phi in drifting_inputs(100, 4):
        gwr.adapt(phi)
    assert_same(state["_extra_state"], saved["_extra_state"])
    assert_same(twin.get_extra_state(), saved["_extra_state"])
    assert torch.equal(graph.weights, saved["_extra_state"][0]["weights"])
    assert torch.equal(match.embedding, embedding)
    match.embedding.zero_()
    assert twin.graph().weights.abs().min() > 0


@pytest.mark.parametrize(
    "damage",
    [
        {"weights": None},
        {"weights": torch.full((2, 1), math.nan)},
        {"weights": torch.zeros(3, 1)},
        {"habituation": torch.tensor([1.0, 3.0])},
        {"edges": torch.tensor([[0, 7]])},
        {"edges": torch.tensor([[1, 1]])},
        {"edges": torch.tensor([[0, 1], [1, 0]]), "ages": torch.tensor([0, 0])},
        {"ages": torch.tensor([-5])},
        {"node": torch.tensor([1, 0])},
        {"next_node": 1},
    ],
    ids=str,
)
def test_damaged_state_is_rejected(damage):
    gwr = GWRB(1)
    (before,) = gwr.get_extra_state()
    missing = {name: before[name] for name in before if name not in damage}
    for state in ([{**before, **damage}], [missing], [None], None):
        with pytest.raises(ValueError, match="damaged"):
            gwr.set_extra_state(state)
    for other in (GWRB(1, batch_size=[2]), GWRB(5)):
        with pytest.raises(ValueError, match="same sizes"):
            gwr.load_state_dict(other.state_dict())
    assert_same(gwr.get_extra_state(), [before])


def test_network_that_grew_in_inference_mode_learns_outside():
    inside, outside = (GWRB(2, GROWING, init="data") for _ in range(2))
    inputs = list(drifting_inputs(60, 2))
    with torch.inference_mode():
        for phi in inputs[:30]:
            inside.adapt(phi.clone())
    for phi in inputs[30:]:
        inside.adapt(phi)
    for phi in inputs:
        outside.adapt(phi)
    assert_same(inside.get_extra_state(), outside.get_extra_state())


# ---- inputs of all kinds


@pytest.mark.parametrize(
    "kind",
    [
        lambda phi: phi.float(),
        lambda phi: phi.tolist(),
        lambda phi: phi.numpy()[..., ::-1].copy()[..., ::-1],
        lambda phi: np.broadcast_to(phi.numpy(), phi.shape),
    ],
    ids=["float32", "lists", "strides", "read-only"],
)
@pytest.mark.parametrize("batch_size", [(), (2,)])
@pytest.mark.filterwarnings("error")
def test_tensors_arrays_and_lists_are_the_same_inputs(kind, batch_size):
    inputs = drifting_inputs(60, *batch_size, 3)
    one, other = (GWRB(3, GROWING, batch_size=batch_size, init="data") for _ in range(2))
    for phi in inputs:
        assert_same(one.adapt(kind(phi)), other.adapt(phi))
    assert_same(one.get_extra_state(), other.get_extra_state())
    assert one.num_nodes.min() > 2
    many = inputs.movedim(0, -2)
    assert_same(one.lookup(kind(many)), other.lookup(many))


@pytest.mark.parametrize(
    ("phi", "mask"),
    [
        ([[1, 2], [3]], None),
        (np.ones((2, 2), complex), None),
        (torch.zeros(2, 3), None),
        ([[0, 0], [-9.5e18, 0]], None),
        ([[0, 0], [0, 0]], [1.0, 1.0]),
        ([[0, 0], [0, 0]], [[True], [False]]),
    ],
)
def test_bad_input_is_rejected_and_changes_nothing(phi, mask):
    gwr = grown(2, 2)
    before = gwr.get_extra_state()
    calls = [lambda: gwr.adapt(phi, mask)]
    if mask is None:
        calls.append(lambda: gwr.lookup(phi))
    for call in calls:
        with pytest.raises(ValueError, match=r"^(phi|mask) must be") as raised:
            call()
        assert "\n" not in str(raised.value)
    assert_same(gwr.get_extra_state(), before)


def test_types_too_coarse_to_learn_in_are_refused():
    gwr = GWRB(2, init="data")
    gwr.adapt([0.0, 1.0])
    for convert in (gwr.half, gwr.bfloat16, lambda: torch.nn.ModuleList([gwr]).half()):
        with pytest.raises(ValueError, match="GWR-B learns in float32 or float64, not in"):
            convert()
    assert gwr.double().lookup([0.0, 1.0]).embedding.dtype == torch.float64
