"""TD3 and SAC: target noise, entropy and temperature by hand, and the state of their noise."""

import copy
import math

import pytest
import torch
from torch import Tensor

from bgpo_trl.modules.actor_critic import Actor
from tests.objectives.losses import (
    ACTION,
    LOSSES,
    STATE,
    constant_critics,
    make_batch,
    make_loss,
    stream,
    twin_losses,
)


def tanh_normal(loc: Tensor, scale: Tensor):
    normal = torch.distributions.Normal(loc, scale)
    squash = torch.distributions.TanhTransform(cache_size=1)
    return torch.distributions.TransformedDistribution(normal, squash)


@pytest.mark.parametrize("bounds", [None, (0.0, 0.35)])
def test_sacs_target_counts_entropy(bounds):
    loss = make_loss("sac", alpha_init=0.2, return_bounds=bounds)
    constant_critics(loss, (0.0, 0.0), (0.5, 0.3))
    batch = make_batch(16)
    plain = (batch["next", "reward"] + 0.98 * 0.3 * ~batch["next", "terminated"]).squeeze(-1)
    output = loss.actor_network(batch["next"].select("state"))
    policy = tanh_normal(output["loc"], output["scale"])
    noise = torch.randn(16, ACTION, generator=stream(50))
    action = (output["loc"] + output["scale"] * noise).tanh()
    entropy = -0.2 * policy.log_prob(action).sum(-1)
    expected = (plain + 0.98 * entropy * ~batch["next", "terminated"].squeeze(-1)).detach()
    if bounds is not None:
        expected = expected.clamp(*bounds)
    torch.testing.assert_close(loss(batch)["target_value"], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("noise", "clip"), [(0.2, 0.5), (2.0, 0.3), (0.0, 0.5), (0.4, 0.0)])
def test_td3_smooths_the_target_action(monkeypatch, noise, clip):
    loss = make_loss("td3", policy_noise=noise, noise_clip=clip)
    loss.target_actor_network_params["mlp", "layers", "1", "bias"].data[0] = 3.0
    batch, judged = make_batch(32), []
    judge = loss.values
    monkeypatch.setattr(
        loss, "values", lambda *args: judged.append(args[1]["action"]) or judge(*args)
    )
    loss.loss_value(batch)
    action = Actor(STATE, ACTION, in_keys=["state"], hidden_sizes=(16,))
    loss.target_actor_network_params.data.to_module(action)
    action = action(batch["next"].select("state"))["action"]
    drawn = torch.randn(32, ACTION, generator=stream(50)) * noise
    assert (drawn.abs() > clip).any() == (noise > 0)
    expected = (action + drawn.clamp(-clip, clip)).clamp(-1, 1)
    torch.testing.assert_close(judged[0], expected)


@twin_losses
def test_noise_is_drawn_from_the_generators_which_the_state_dict_holds(name):
    loss, batch = make_loss(name, (0, 1), stacked=True), make_batch(2, 16)
    global_state = torch.random.get_rng_state()
    loss(batch.clone())
    state = copy.deepcopy(loss.state_dict())
    results = [loss(batch.clone()) for _ in range(2)]
    assert not results[0]["target_value"].equal(results[1]["target_value"])
    assert torch.random.get_rng_state().equal(global_state)
    again = make_loss(name, (7, 8), stacked=True)
    again.load_state_dict(state)
    for result in results:
        for key, value in again(batch.clone()).items():
            assert value.equal(result[key]), key
    networks = loss.actor_network, loss.value_network
    unseeded = LOSSES[name][0](*networks)
    with pytest.raises(ValueError, match="2 generators"):
        unseeded.noise.load_state_dict(loss.noise.state_dict())
    with pytest.raises(ValueError, match="2 are needed, got 1"):
        LOSSES[name][0](*networks, generator=[stream(0)])


def test_td3s_actor_climbs_the_first_critic_and_sacs_the_lower_one():
    for name in ("td3", "sac"):
        loss, batch = make_loss(name, return_bounds=None), make_batch(16)
        constant_critics(loss, (0.6, 0.2), (0.0, 0.0))
        result = loss(batch.clone())
        if name == "td3":
            pre_tanh = loss.actor_network(batch.clone())["pre_tanh_action"]
            expected = -0.6 + 0.01 * pre_tanh.square().mean()
        else:
            expected = -0.1 * result["entropy"] - 0.2
        torch.testing.assert_close(result["loss_actor"], expected)


def test_each_seeds_temperature_moves_its_entropy_towards_the_target():
    loss = make_loss("sac", (0, 1), stacked=True, alpha_init=0.5, target_entropy=-1.0)
    optimizer = torch.optim.Adam([loss.log_alpha], lr=0.01)
    with torch.no_grad():  # the first seed's policy is nearly certain, the second's is wide
        scales = loss.actor_network_params["mlp", "layers", "1", "bias"][..., ACTION:]
        scales.copy_(torch.tensor([[-4.0], [0.0]]).expand(2, ACTION))
    result = loss(make_batch(2, 64))
    assert result["entropy"][0] < -1.0 < result["entropy"][1]
    torch.testing.assert_close(result["alpha"], torch.tensor([0.5, 0.5]))
    expected = math.log(0.5) * (result["entropy"] + 1.0).sum()
    torch.testing.assert_close(result["loss_alpha"], expected)
    result["loss_alpha"].backward()
    optimizer.step()
    alpha = loss.log_alpha.exp()
    assert alpha[0] > 0.5 > alpha[1]


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [
        ("td3", "policy_noise", -0.1),
        ("td3", "noise_clip", math.nan),
        ("td3", "pre_tanh_penalty", -1.0),
        ("sac", "alpha_init", 0.0),
    ],
)
def test_bad_options_are_refused(name, option, value):
    with pytest.raises(ValueError, match=option):
        make_loss(name, **{option: value})
