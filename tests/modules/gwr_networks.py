"""A plain reference of GWR-B, and inputs and comparisons for tests of it."""

import math
from typing import Any

import torch

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
