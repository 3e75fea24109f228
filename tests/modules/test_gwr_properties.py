"""Properties of GWR-B that hold for any input."""

import itertools

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.modules.gwr import GWRB
from tests.modules.gwr_networks import assert_same_state, state_of

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
