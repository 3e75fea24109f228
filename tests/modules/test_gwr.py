"""GWR-B's algorithm against a plain reference and hand-computed numbers."""

import itertools
import math

import pytest
import torch

from bgpo_trl.modules.gwr import GWRB
from tests.modules.gwr_networks import (
    ALWAYS_INSERT,
    GROWING,
    Reference,
    assert_same_network,
    drifting_inputs,
    from_data,
)

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
