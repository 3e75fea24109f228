"""Inputs and arguments that GWR-B takes, and those that it refuses."""

import math

import numpy as np
import pytest
import torch

from bgpo_trl.modules.gwr import GWRB
from tests.modules.gwr_networks import GROWING, assert_same_state, drifting_inputs, state_of

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


@pytest.mark.parametrize("sign", [1, -1])
def test_inputs_are_as_large_as_their_squared_distances_allow(sign):
    gwr, far = GWRB(1, init="data"), 9e18  # the square of twice as much is just below 3.4e38
    gwr.adapt([far])
    assert gwr.lookup([-far]).activity == 0
    assert gwr.lookup([far]).activity == 1
    with pytest.raises(ValueError, match=r"values beyond \+-9e\+18$"):
        gwr.adapt([sign * 9.5e18])
