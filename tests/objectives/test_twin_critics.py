"""TD3 and SAC against numbers worked out by hand, TorchRL's own losses, and each seed alone."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl import objectives
from torchrl.modules import ProbabilisticActor, TanhNormal

from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.modules.gaussian_actor import GaussianActor
from bgpo_trl.objectives.sac import SACLoss
from bgpo_trl.objectives.target_update import ForeachSoftUpdate
from bgpo_trl.objectives.td3 import TD3Loss

STATE, ACTION = 6, 4
LOSSES = {"td3": (TD3Loss, Actor), "sac": (SACLoss, GaussianActor)}
both = pytest.mark.parametrize("name", LOSSES)


def stream(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_loss(name, seeds=(0,), *, stacked=False, **options):
    """Makes a loss of one seed, or of a stack of them; a seed starts the same in either."""
    options = {"entropy_in_target": True, **options} if name == "sac" else options
    loss, actor = LOSSES[name]
    shape = [len(seeds)] if stacked else []
    network = {"in_keys": ["state"], "hidden_sizes": (16,)}
    first = {"batch_size": shape, "generator": [stream(seed) for seed in seeds]}
    twins = [stream(100 * (seed + 1) + i) for seed in seeds for i in range(2)]
    noise = [stream(seed + 50) for seed in seeds]
    made = loss(
        actor(STATE, ACTION, **network, **first),
        Critic(STATE, ACTION, **network, batch_size=[*shape, 2], generator=twins),
        generator=noise if stacked else noise[0],
        **options,
    )
    made.make_value_estimator(gamma=0.98)
    ForeachSoftUpdate(made, tau=0.005)
    return made


def make_batch(*shape, seed=0):
    generator = stream(seed)
    terminated = torch.rand(*shape, 1, generator=generator) < 0.2
    successor = {
        "state": torch.randn(*shape, STATE, generator=generator),
        "reward": torch.rand(*shape, 1, generator=generator) * terminated,
        "done": terminated.clone(),
        "terminated": terminated,
    }
    state = torch.randn(*shape, STATE, generator=generator)
    action = torch.rand(*shape, ACTION, generator=generator) * 2 - 1
    return TensorDict({"state": state, "action": action, "next": successor}, shape)


def total(losses: TensorDict) -> Tensor:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def constant_critics(loss, online: tuple, target: tuple) -> None:
    """Makes both Q-functions and both target Q-functions equal to these numbers everywhere."""
    for params, values in (
        (loss.value_network_params, online),
        (loss.target_value_network_params, target),
    ):
        for tensor in params.values(True, True):
            tensor.data.zero_()
        params["mlp", "layers", "1", "bias"].data.copy_(torch.tensor(values).unsqueeze(-1))


# reward, terminated -> target with gamma 0.98 and the smaller next value of 0.3
TRANSITIONS = [(0.0, False, 0.294), (0.0, True, 0.0), (1.0, True, 1.0), (1.0, False, 1.294)]


def transitions() -> tuple[TensorDict, Tensor]:
    reward, terminated, target = (torch.tensor(c) for c in zip(*TRANSITIONS, strict=True))
    batch = make_batch(len(TRANSITIONS))
    batch["next", "reward"] = reward.unsqueeze(-1)
    batch["next", "terminated"] = terminated.unsqueeze(-1)
    return batch, target


@both
@pytest.mark.parametrize("target_values", [(0.3, 0.5), (0.5, 0.3)])
@pytest.mark.parametrize("bounds", [None, (0.0, 1.1), (0.1, 0.2)])
def test_the_smaller_target_value_is_believed_within_bounds(name, target_values, bounds):
    options = {"entropy_in_target": False} if name == "sac" else {}
    loss = make_loss(name, return_bounds=bounds, **options)
    constant_critics(loss, (0.2, 0.6), target_values)
    batch, target = transitions()
    target = target if bounds is None else target.clamp(*bounds)
    result = loss(batch)
    torch.testing.assert_close(result["target_value"], target)
    squares = (0.2 - target).square(), (0.6 - target).square()
    torch.testing.assert_close(result["loss_value"], (squares[0] + squares[1]).mean())
    torch.testing.assert_close(batch["td_error"], torch.maximum(*squares))
    torch.testing.assert_close(result["td_error_max"], torch.maximum(*squares).max())


@both
def test_rewards_of_any_range_are_learned_by_default(name):
    loss = make_loss(name, **({"entropy_in_target": False} if name == "sac" else {}))
    constant_critics(loss, (0.0, 0.0), (-100.0, -90.0))
    batch, _ = transitions()
    batch["next", "reward"].fill_(-16.0)
    target = torch.where(batch["next", "terminated"], -16.0, -16.0 - 0.98 * 100).squeeze(-1)
    torch.testing.assert_close(loss(batch)["target_value"], target)


def tanh_normal(loc: Tensor, scale: Tensor):
    normal = torch.distributions.Normal(loc, scale)
    squash = torch.distributions.TanhTransform(cache_size=1)
    return torch.distributions.TransformedDistribution(normal, squash)


@pytest.mark.parametrize("bounds", [None, (0.0, 0.35)])
def test_sacs_target_counts_entropy(bounds):
    loss = make_loss("sac", alpha_init=0.2, return_bounds=bounds)
    constant_critics(loss, (0.0, 0.0), (0.5, 0.3))
    batch, plain = transitions()
    told = loss.actor_network(TensorDict({"state": batch["next", "state"]}, [4]))
    policy = tanh_normal(told["loc"], told["scale"])
    noise = torch.randn(4, ACTION, generator=stream(50))
    action = (told["loc"] + told["scale"] * noise).tanh()
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


@both
def test_without_options_it_is_torchrls_loss(name):
    options = {"return_bounds": None}
    options |= {"pre_tanh_penalty": 0.0} if name == "td3" else {"alpha_init": 0.3}
    loss = make_loss(name, **options)
    critics = [Critic(STATE, ACTION, in_keys=["state"], hidden_sizes=(16,)) for _ in range(2)]
    for index, critic in enumerate(critics):
        weights = loss.value_network.state_dict()
        critic.load_state_dict({key: value[index] for key, value in weights.items()})
    actor = copy.deepcopy(loss.actor_network)
    if name == "td3":
        reference = objectives.TD3Loss(actor, critics, bounds=(-1.0, 1.0), loss_function="l2")
    else:
        policy = ProbabilisticActor(
            actor,
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            return_log_prob=True,
        )
        reference = objectives.SACLoss(
            policy, critics, alpha_init=0.3, target_entropy=-4.0, loss_function="l2"
        )
    reference.make_value_estimator(objectives.ValueEstimators.TD0, gamma=0.98)
    objectives.SoftUpdate(reference, tau=0.005)
    batch = make_batch(16)
    mine = loss(batch.clone())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(50)  # what the generator of the noise was given
        theirs = reference(batch.clone())
    keys = ["loss_actor", "loss_qvalue", *(["loss_alpha"] if name == "sac" else [])]
    for key in keys:
        ours = mine[key.replace("qvalue", "value")]  # TorchRL's name of it where there are two
        torch.testing.assert_close(ours, theirs[key], rtol=1e-4, atol=1e-5)
    total(mine).backward()
    sum(theirs[key] for key in keys).backward()
    assert len(list(loss.parameters())) == len(list(reference.parameters()))
    for ours, other in zip(loss.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, other.grad, rtol=1e-3, atol=1e-5)


@both
def test_stacked_seeds_are_each_seed_alone(name):
    seeds = (0, 1, 2)
    stacked = make_loss(name, seeds, stacked=True)
    alone = [make_loss(name, (seed,)) for seed in seeds]
    losses = [stacked, *alone]
    optimizers = [torch.optim.Adam(list(loss.parameters()), lr=1e-3) for loss in losses]
    updates = [ForeachSoftUpdate(loss, tau=0.005) for loss in losses]
    for step in range(20):
        batch = make_batch(len(seeds), 32, seed=step)
        results = [loss(data) for loss, data in zip(losses, [batch, *batch.unbind(0)], strict=True)]
        for loss, result in zip(losses, results, strict=True):
            loss.zero_grad()
            total(result).backward()
        if step == 0:
            for index, one in enumerate(alone):
                for ours, theirs in zip(stacked.parameters(), one.parameters(), strict=True):
                    torch.testing.assert_close(ours.grad[index], theirs.grad)
        for key, together in results[0].items():
            apart = torch.stack([result[key] for result in results[1:]])
            expected = apart.sum(0) if key.startswith("loss_") else apart
            torch.testing.assert_close(together, expected, rtol=1e-4, atol=1e-4)
        for optimizer, update in zip(optimizers, updates, strict=True):
            optimizer.step()
            update.step()
    for index, one in enumerate(alone):
        for ours, theirs in zip(stacked.parameters(), one.parameters(), strict=True):
            torch.testing.assert_close(ours[index], theirs, rtol=1e-4, atol=1e-4)


@both
def test_noise_is_its_own_and_continues_from_the_state_dict(name):
    loss, batch = make_loss(name, (0, 1), stacked=True), make_batch(2, 16)
    chance = torch.random.get_rng_state()
    loss(batch.clone())
    state = copy.deepcopy(loss.state_dict())
    then = [loss(batch.clone()) for _ in range(2)]
    assert not then[0]["target_value"].equal(then[1]["target_value"])
    assert torch.random.get_rng_state().equal(chance)
    again = make_loss(name, (7, 8), stacked=True)
    again.load_state_dict(state)
    for result in then:
        for key, value in again(batch.clone()).items():
            assert value.equal(result[key]), key


@both
def test_each_network_learns_from_its_own_loss(name):
    loss = make_loss(name)
    parts = {
        "loss_actor": list(loss.actor_network_params.parameters()),
        "loss_value": list(loss.value_network_params.parameters()),
        **({"loss_alpha": [loss.log_alpha]} if name == "sac" else {}),
    }
    for key, learning in parts.items():
        loss.zero_grad()
        loss(make_batch(16))[key].backward()
        for other, parameters in parts.items():
            for parameter in parameters:
                assert (parameter.grad is None) == (other != key)
        assert all(parameter.grad.any() for parameter in learning)


def test_td3s_actor_climbs_the_first_critic_and_sacs_the_lower_one():
    for name in LOSSES:
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


@both
def test_constant_entries_are_not_needed_under_next(name):
    loss, actor = LOSSES[name]
    network = {"in_keys": ["state", "behavior"], "generator": stream(0)}
    networks = [
        actor(STATE + 2, ACTION, **network),
        Critic(STATE + 2, ACTION, batch_size=[2], **network),
    ]
    losses = [
        loss(*networks, constant_keys=keys, generator=stream(1)) for keys in ([], ["behavior"])
    ]
    for made in losses:
        ForeachSoftUpdate(made, tau=0.005)
    batch = make_batch(8).set("behavior", torch.randn(8, 2))
    with pytest.raises(ValueError, match="under 'next', found no 'behavior'"):
        losses[0](batch.clone())
    lean = losses[1](batch.clone())
    batch["next", "behavior"] = batch["behavior"]
    torch.testing.assert_close(lean["target_value"], losses[0](batch)["target_value"])


@both
def test_what_tells_success_from_a_time_out_must_be_there(name):
    with pytest.raises(ValueError, match=r"lacks .*terminated"):
        make_loss(name)(make_batch(4).exclude(("next", "terminated")))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("td3", {"return_bounds": (1.0, 1.0)}, "return_bounds"),
        ("td3", {"policy_noise": -0.1}, "policy_noise and noise_clip"),
        ("td3", {"noise_clip": math.nan}, "policy_noise and noise_clip"),
        ("td3", {"pre_tanh_penalty": -1.0}, "pre_tanh_penalty"),
        ("sac", {"alpha_init": 0.0}, "alpha_init"),
    ],
)
def test_bad_options_are_refused(name, options, message):
    with pytest.raises(ValueError, match=message):
        make_loss(name, **options)


@both
def test_networks_and_generators_that_do_not_fit_are_refused(name):
    loss, actor = LOSSES[name]
    policy = actor(STATE, ACTION, batch_size=[3])
    with pytest.raises(ValueError, match=r"batch_size \[3, 2\], got \[3\]"):
        loss(policy, Critic(STATE, ACTION, batch_size=[3]))
    with pytest.raises(ValueError, match="3 are needed, got 1"):
        loss(policy, Critic(STATE, ACTION, batch_size=[3, 2]), generator=[stream(0)])


def test_each_transition_has_a_draw_of_its_own_whatever_the_batch_size():
    loss, batch = make_loss("sac"), make_batch(32)
    batch["next", "state"] = batch["next", "state"][:1].expand(32, STATE).clone()
    batch["next", "terminated"] = torch.zeros(32, 1, dtype=torch.bool)
    batch["next", "reward"] = torch.zeros(32, 1)
    loss(batch)
    within = loss.target(batch)
    loss = make_loss("sac")
    without = TensorDict({**batch.exclude("td_error").to_dict()}, [])
    loss(without)
    torch.testing.assert_close(loss.target(without), within)
    assert len(within.unique()) == 32


def test_a_state_with_another_number_of_generators_is_refused():
    seeded = make_loss("td3", (0, 1), stacked=True)
    actor, critics = (
        Actor(STATE, ACTION, in_keys=["state"], hidden_sizes=(16,), batch_size=(2,)),
        Critic(STATE, ACTION, in_keys=["state"], hidden_sizes=(16,), batch_size=(2, 2)),
    )
    unseeded = TD3Loss(actor, critics)
    with pytest.raises(ValueError, match="saved with 2 generators, this loss has 0"):
        unseeded.load_state_dict(seeded.state_dict())


def test_sacs_target_entropy_counts_the_actions_unless_told():
    networks = [
        (
            GaussianActor(STATE, n, in_keys=["state"]),
            Critic(STATE, n, in_keys=["state"], batch_size=2),
        )
        for n in (1, 3)
    ]
    assert [SACLoss(*pair).target_entropy for pair in networks] == [-1.0, -3.0]
    assert SACLoss(*networks[0], target_entropy=-4.0).target_entropy == -4.0


def test_sacs_noise_is_of_real_numbers_whatever_the_observation():
    class Whole(GaussianActor):
        """Reads whole numbers."""

        def sample(self, tensordict, noise):
            assert noise.dtype == torch.float32
            return super().sample(tensordict.set("state", tensordict["state"].float()), noise)

    critic = Critic(STATE, ACTION, in_keys=["state"], batch_size=2)
    loss = SACLoss(Whole(STATE, ACTION, in_keys=["state"]), critic, constant_keys=["state"])
    loss.make_value_estimator()
    batch = make_batch(8)
    batch["state"] = batch["state"].long()
    assert loss.next_value(loss.inputs.following(batch, loss.tensor_keys)).shape == (8,)
