"""Properties of GWR-B that hold for any sizes, constants and inputs."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.modules.gwr import GWRB
from tests.helpers import through_a_file


@st.composite
def configs(draw):
    """Any constants that GWR-B takes."""
    best = draw(st.floats(0, 1))
    start = draw(st.floats(0.05, 1))
    alpha = st.floats(1 / start, 20 / start)
    tau = st.floats(0.05, 50)
    return GWRBConfig(
        activity_threshold=draw(st.floats(0, 1)),
        activity_scale=draw(st.floats(1e-3, 1e3)),
        habituation_threshold=draw(st.floats(0, 2)),
        lr_best=best,
        lr_neighbor=draw(st.floats(0, best)),
        initial_habituation=start,
        alpha_best=draw(alpha),
        alpha_neighbor=draw(alpha),
        tau_best=draw(tau),
        tau_neighbor=draw(tau),
        max_age=draw(st.integers(1, 6)),
    )


options = st.fixed_dictionaries(
    {
        "config": configs(),
        "max_nodes": st.none() | st.integers(2, 6),
        "init": st.sampled_from(["random", "data"]),
    }
)

NUMBERS = [0.0, 0.25, 0.5, 1.0, -1.0]  # few, so that inputs repeat and distances tie
SCALES = [1.0, 1.0, 1.0, 1e-30, 1e-6, 1e6, 1e17]  # and some are far from all the others
EVENTS = ["save and load", "look up", math.nan, math.inf, -math.inf, 3e38]


@st.composite
def histories(draw):
    """Batch size, and steps: inputs ``[n, d]``, who takes part ``[n]``, and what comes before."""
    d, batch = draw(st.integers(1, 4)), draw(st.sampled_from([(), (1,), (3,), (2, 2)]))
    count, n_steps = math.prod(batch), draw(st.integers(1, 150))
    # Drawn here and not by hypothesis, which would not make them long enough for edges to expire.
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    scales = draw(st.sampled_from([SCALES, [1.0]]))
    steps = []
    for _ in range(n_steps):
        numbers = rng.choice([*NUMBERS, rng.normal()], (count, d))
        points = torch.from_numpy(numbers * rng.choice(scales, (count, 1))).float()
        event = EVENTS[rng.integers(len(EVENTS))] if rng.random() < 0.2 else ""
        steps.append((points, torch.from_numpy(rng.random(count) < 0.8), event))
    return batch, steps


def assert_same(a, b):
    torch.testing.assert_close(a, b, rtol=0, atol=0)


def assert_sound(gwr, largest):
    """Assert the invariants of Sec. III-B, of all networks; ``largest`` bounds all inputs."""
    c, d = gwr.config, gwr.n_features
    floor = c.initial_habituation - 1 / min(c.alpha_best, c.alpha_neighbor)
    for network, n_nodes in zip(gwr.get_extra_state(), gwr.num_nodes.flatten(), strict=True):
        n = len(network["node"])
        assert n == n_nodes <= (gwr.max_nodes or n)
        assert n == len(network["habituation"])
        assert network["weights"].shape == (n, d)
        assert (network["weights"].abs() <= largest * (1 + 1e-6)).all()
        assert network["habituation"].ge(floor - 1e-9).all()
        assert network["habituation"].le(c.initial_habituation + 1e-9).all()
        assert (network["node"].diff() > 0).all()
        assert (network["node"] < network["next_node"]).all()
        edges = [tuple(edge) for edge in network["edges"].tolist()]
        assert len(set(edges)) == len(edges) == len(network["ages"])
        assert all(0 <= a < b < n for a, b in edges)  # each once, and no loops
        assert ((network["ages"] >= 0) & (network["ages"] <= c.max_age)).all()
        assert n < 2 or {node for edge in edges for node in edge} == set(range(n))


def saved_and_loaded(gwr):
    loaded = GWRB(gwr.n_features, gwr.config, batch_size=gwr.batch_size, max_nodes=gwr.max_nodes)
    loaded.load_state_dict(through_a_file(gwr.state_dict()))
    return loaded


@pytest.mark.parametrize("n", [20, pytest.param(500, marks=pytest.mark.slow)])
def test_networks_stay_sound_and_each_learns_in_a_batch_as_it_does_alone(n):
    removed = 0

    @settings(max_examples=n)
    @given(options=options, history=histories(), seed=st.integers(0, 99))
    def holds(options, history, seed):
        nonlocal removed
        batch, steps = history
        count, d = steps[0][0].shape
        streams = [torch.Generator().manual_seed(seed + i) for i in range(count)]
        gwr = GWRB(d, batch_size=batch, generator=streams, **options)
        alone = [
            GWRB(d, generator=torch.Generator().manual_seed(seed + i), **options)
            for i in range(count)
        ]
        largest = max(1.0, *(float(points.abs().max()) for points, _, _ in steps))
        for points, chosen, event in steps:
            phi, mask, looked_up = points.view(*batch, d), chosen.view(batch), None
            if event == "save and load":
                gwr = saved_and_loaded(gwr)
            elif event == "look up" and gwr.num_nodes.all():
                before = gwr.get_extra_state()
                looked_up = gwr.lookup(phi)
                assert_same(gwr.get_extra_state(), before)
            elif isinstance(event, float):  # is refused for all, if one network is to learn it
                before, spoilt = gwr.get_extra_state(), points.clone()
                spoilt[-1, 0] = event
                with pytest.raises(ValueError, match="NaN, Inf"):
                    gwr.adapt(spoilt.view(*batch, d))
                assert_same(gwr.get_extra_state(), before)
            match = gwr.adapt(phi, mask)
            if looked_up is not None:
                assert_same(match[mask], looked_up[mask])
            assert_sound(gwr, largest)
            matches = match.view(-1) if batch else match.unsqueeze(0)
            for i in chosen.nonzero().flatten().tolist():
                assert alone[i].adapt(points[i]).node == matches.node[i]
        for network, state in zip(alone, gwr.get_extra_state(), strict=True):
            assert_same(network.get_extra_state()[0], state)
            removed += state["next_node"] - len(state["node"])

    holds()
    assert removed > 0  # else, no edge of any example has expired
