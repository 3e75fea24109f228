"""Shared behavior of the off-policy losses, by hand and beside TorchRL's own losses."""

import copy
import math
from functools import partial

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl import objectives
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives.value import TD0Estimator

from bgpo_trl.configs import RLConfig
from bgpo_trl.modules.actor_critic import Critic
from bgpo_trl.objectives.ddpg import DDPGLoss
from bgpo_trl.objectives.off_policy import ForeachSoftUpdate
from tests.objectives.losses import (
    ACTION,
    LOSSES,
    STATE,
    constant_critics,
    every_loss,
    gradients,
    make_batch,
    make_loss,
    total,
)

BOTH_INPUTS = ("state", "label")
# reward, done, terminated -> target with gamma 0.98 and a next value of 0.3
TRANSITIONS = [
    (0.0, False, False, 0.294),
    (0.0, True, False, 0.294),  # truncated: the bootstrap goes on
    (0.0, True, True, 0.0),
    (0.3, True, True, 0.3),
    (1.0, False, False, 1.294),
    (-16.0, False, False, -15.706),  # as Pendulum's may be
]


@pytest.mark.parametrize(
    ("name", "target_values"),
    [
        ("ddpg", 0.3),
        *((name, pair) for name in ("td3", "sac") for pair in ((0.3, 0.5), (0.5, 0.3))),
    ],
)
@pytest.mark.parametrize("bounds", [None, (0.0, 1.1), (-0.2, 0.2)])
def test_targets_and_value_loss_by_hand(name, target_values, bounds):
    """Twin critics bootstrap from the smaller value; targets have bounds only where given."""
    options = {"entropy_in_target": False} if name == "sac" else {}
    options |= {} if bounds is None else {"return_bounds": bounds}
    loss = make_loss(name, **options)
    online = 0.2 if name == "ddpg" else (0.2, 0.6)
    constant_critics(loss, online, target_values)
    reward, done, terminated, target = (torch.tensor(c) for c in zip(*TRANSITIONS, strict=True))
    batch = make_batch(len(TRANSITIONS))
    for key, value in {"reward": reward, "done": done, "terminated": terminated}.items():
        batch["next", key] = value.unsqueeze(-1)
    target = target if bounds is None else target.clamp(*bounds)
    squares = (torch.tensor(online).reshape(-1, 1) - target).square()
    result = loss(batch)
    torch.testing.assert_close(result["target_value"], target)
    torch.testing.assert_close(result["target_value_max"], target.max())
    if name == "ddpg":
        pre_tanh = loss.actor_network(batch.clone())["pre_tanh_action"].detach()
        magnitude = pre_tanh.square().mean().sqrt()
        torch.testing.assert_close(result["pre_tanh_magnitude"], magnitude)
    torch.testing.assert_close(result["loss_value"], squares.sum(0).mean())
    torch.testing.assert_close(batch["td_error"], squares.amax(0))
    torch.testing.assert_close(result["td_error_max"], squares.max())


@every_loss
def test_without_options_it_is_torchrls_loss(name):
    loss = make_loss(name, **({"alpha_init": 0.3} if name == "sac" else {"pre_tanh_penalty": 0.0}))
    actor = copy.deepcopy(loss.actor_network)
    if name == "ddpg":
        critic = copy.deepcopy(loss.value_network)
        reference = objectives.DDPGLoss(actor, critic, delay_actor=True)
    else:
        critics = [Critic(STATE, ACTION, in_keys=["state"], hidden_sizes=(16,)) for _ in range(2)]
        weights = loss.value_network.state_dict()
        for index, critic in enumerate(critics):
            critic.load_state_dict({key: value[index] for key, value in weights.items()})
    if name == "td3":
        reference = objectives.TD3Loss(actor, critics, bounds=(-1.0, 1.0), loss_function="l2")
    if name == "sac":
        policy = ProbabilisticActor(
            actor, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
        )
        reference = objectives.SACLoss(
            policy, critics, alpha_init=0.3, target_entropy=-4.0, loss_function="l2"
        )
    reference.make_value_estimator(objectives.ValueEstimators.TD0, gamma=0.98)
    objectives.SoftUpdate(reference, tau=0.005)
    batch = make_batch(16)
    mine = loss(batch.clone())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(50)  # the seed of the loss's own noise
        theirs = reference(batch.clone())
    keys = [key for key, _ in theirs.items() if key.startswith("loss_")]
    for key in keys:
        own_key = key.replace("qvalue", "value")  # TorchRL's name of it where there are two
        torch.testing.assert_close(mine[own_key], theirs[key], rtol=1e-4, atol=1e-5)
    total(mine).backward()
    total(theirs).backward()
    for ours, other in zip(loss.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, other.grad, rtol=1e-3, atol=1e-5)


@every_loss
def test_each_seed_of_a_stack_learns_as_it_does_alone(name):
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-4)
    seeds = (0, 1, 2)
    stacked, *alone = losses = [
        make_loss(name, seeds, stacked=True),
        *(make_loss(name, (seed,)) for seed in seeds),
    ]
    optimizers = [torch.optim.Adam(list(loss.parameters()), lr=1e-3) for loss in losses]
    updates = [ForeachSoftUpdate(loss, tau=0.005) for loss in losses]
    for step in range(10):
        batch = make_batch(len(seeds), 32, seed=step)
        results = [loss(data) for loss, data in zip(losses, [batch, *batch.unbind(0)], strict=True)]
        for loss, result in zip(losses, results, strict=True):
            loss.zero_grad()
            total(result).backward()
        for key, together in results[0].items():
            apart = torch.stack([result[key] for result in results[1:]])
            close(together, apart.sum(0) if key.startswith("loss_") else apart)
        for index, one in enumerate(alone):
            for ours, theirs in zip(stacked.parameters(), one.parameters(), strict=True):
                if step == 0:
                    torch.testing.assert_close(ours.grad[index], theirs.grad)
                close(ours[index], theirs)
        for optimizer, update in zip(optimizers, updates, strict=True):
            optimizer.step()
            update.step()


@every_loss
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


@every_loss
def test_constant_entries_are_not_needed_under_next(name):
    plain = make_loss(name, in_keys=BOTH_INPUTS)
    lean = make_loss(name, in_keys=BOTH_INPUTS, constant_keys=["label"])
    batch = make_batch(8)
    without = batch.exclude(("next", "label"))
    with pytest.raises(ValueError, match="under 'next', found no 'label'"):
        plain(without)
    target = lean(without)["target_value"]
    batch["next", "label"] = batch["label"]
    fresh = make_loss(name, in_keys=BOTH_INPUTS)  # with the same draws
    torch.testing.assert_close(target, fresh(batch)["target_value"])


@every_loss
def test_entries_may_have_other_names(name):
    batch = make_batch(4)
    expected = make_loss(name)(batch.clone())
    other = batch.exclude(("next", "reward"), ("next", "terminated"))
    other["next", "pay"] = batch["next", "reward"]
    other["next", "won"] = batch["next", "terminated"]
    loss = make_loss(name)
    loss.set_keys(reward="pay", terminated="won", priority="error")
    result = loss(other)
    assert set(result.keys()) == set(loss.out_keys)
    for key, value in result.items():
        assert value.equal(expected[key]), key
    assert other["error"].amax().equal(expected["td_error_max"])
    loss.make_value_estimator(gamma=0.5)  # keeps the names
    assert not loss(other)["target_value"].equal(expected["target_value"])
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(prize="pay")


@every_loss
def test_the_discount_is_that_of_the_value_estimator(name):
    kind, actor = LOSSES[name]
    critics = Critic(STATE, batch_size=(2,) if kind.twin_critics else ())
    by_default = kind(actor(STATE), critics).value_estimator.gamma.item()
    assert by_default == pytest.approx(RLConfig.gamma)
    batch = make_batch(4)
    batch["next", "terminated"].zero_()
    batch["next", "reward"].zero_()
    options = {"entropy_in_target": False} if name == "sac" else {}
    loss = make_loss(name, **options)
    constant_critics(loss, 0.0, 0.5)
    for estimator in (None, objectives.ValueEstimators.TD0, TD0Estimator):
        loss.make_value_estimator(estimator, gamma=0.5)
        torch.testing.assert_close(loss(batch)["target_value"], torch.full((4,), 0.25))
    for gamma in (1.5, math.nan):
        with pytest.raises(ValueError, match="gamma"):
            loss.make_value_estimator(gamma=gamma)
    with pytest.raises(NotImplementedError):
        loss.make_value_estimator(objectives.ValueEstimators.GAE)


@every_loss
def test_targets_of_several_steps_are_discounted_as_often(name):
    loss = make_loss(name, **({"entropy_in_target": False} if name == "sac" else {}))
    constant_critics(loss, 0.0, 0.5)
    batch = make_batch(8)
    batch["next", "terminated"].zero_()
    steps = torch.arange(1, 9).unsqueeze(-1)
    target = loss(batch.set("steps_to_next_obs", steps))["target_value"]
    expected = batch["next", "reward"] + 0.5 * 0.98**steps
    torch.testing.assert_close(target, expected.squeeze(-1))


@every_loss
@pytest.mark.parametrize("change", [copy.deepcopy, lambda loss: loss.double().float()])
def test_a_copied_or_cast_loss_still_follows_its_parameters(name, change):
    loss, batch = make_loss(name), make_batch(16)
    loss(batch.clone())  # networks that were made for it must not outlive the change
    loss, fresh = change(loss), make_loss(name, (1,))
    loss.load_state_dict(fresh.state_dict())
    mine, theirs = loss(batch.clone()), fresh(batch.clone())
    for key, value in theirs.items():
        torch.testing.assert_close(mine[key], value)
    for grad, other in zip(gradients(loss, batch), gradients(fresh, batch), strict=True):
        torch.testing.assert_close(grad, other)


@every_loss
def test_soft_updates_are_torchrls_also_after_a_cast(name):
    losses = make_loss(name), make_loss(name)
    updates = ForeachSoftUpdate(losses[0], tau=0.1), objectives.SoftUpdate(losses[1], tau=0.1)
    before = losses[0].target_value_network_params.clone()
    for loss, update in zip(losses, updates, strict=True):
        loss.double()
        for parameter in loss.parameters():
            parameter.data.add_(1.0)
        for _ in range(3):
            update.step()
    expected = losses[1].state_dict()
    for entry, value in losses[0].state_dict().items():
        torch.testing.assert_close(value, expected[entry])
    moved = losses[0].target_value_network_params.sub(before).values(True, True)
    assert all(torch.allclose(value, torch.full_like(value, 1 - 0.9**3)) for value in moved)


@every_loss
def test_bad_arguments_are_refused(name):
    kind, actor = LOSSES[name]
    policy = actor(3, 2, in_keys=["state"], batch_size=(3,))
    stack = (3, 2) if kind.twin_critics else (3,)
    critics = Critic(3, 2, in_keys=["state"], batch_size=stack)
    # A container hides the batch size, and with it the seeds whose losses are summed.
    for actor_network, value_network in (
        (TensorDictSequential(policy), critics),
        (policy, Critic(3, 2, in_keys=["state"], batch_size=(2,))),
    ):
        with pytest.raises(ValueError, match="batch_size"):
            kind(actor_network, value_network)
    for option, value in (
        ("return_bounds", (1.0, 1.0)),
        ("imitation", math.nan),
        ("constant_keys", ["lable"]),
    ):
        with pytest.raises(ValueError, match=option):
            kind(policy, critics, **{option: value})


def test_weights_are_factors_of_each_transitions_losses():
    loss, batch = make_loss("ddpg", pre_tanh_penalty=0.5), make_batch(8)
    weights = torch.linspace(0, 2, 8)
    plain = loss(batch.clone())
    error = (plain["pred_value"] - plain["target_value"]).square()
    data = loss.actor_network(batch.select("state"))
    value = loss.value_network(data)["state_action_value"].squeeze(-1)
    penalty = 0.5 * data["pre_tanh_action"].square().mean(-1)
    batch["priority_weight"] = weights
    result = loss(batch)
    torch.testing.assert_close(result["loss_value"], (weights * error).mean())
    torch.testing.assert_close(result["loss_actor"], (weights * (penalty - value)).mean())
    loss.use_prioritized_weights = False
    torch.testing.assert_close(loss(batch)["loss_value"], error.mean())


@pytest.mark.parametrize("layer_norm", [False, True])
def test_seeds_of_weight_zero_have_no_gradient_and_change_no_others(layer_norm):
    """`TaskReplay` gives zeros for tasks without data."""
    loss = make_loss("ddpg", range(4), stacked=True, layer_norm=layer_norm)
    batch, idle, active = make_batch(4, 32), [1, 3], [0, 2]
    everything = gradients(loss, batch)
    batch["priority_weight"] = torch.tensor([1.0, 0, 1, 0]).unsqueeze(-1).expand(4, 32).clone()
    weighted = gradients(loss, batch)
    for index in idle:
        batch[index] = batch[index].apply(torch.zeros_like)
    for grad, zeroed, unweighted in zip(weighted, gradients(loss, batch), everything, strict=True):
        assert unweighted.flatten(1).any(-1).all()
        for of_weighted in (grad, zeroed):
            assert not of_weighted[idle].any()
            assert of_weighted[active].equal(unweighted[active])


def test_an_actor_without_pre_tanh_actions_needs_no_penalty_and_reports_no_magnitude():
    actor = TensorDictModule(torch.nn.Linear(STATE, ACTION), ["state"], ["action"])
    critic, batch = Critic(STATE, ACTION, in_keys=["state"]), make_batch(4)
    loss = DDPGLoss(actor, critic)
    with pytest.raises(ValueError, match="pre_tanh_penalty=0"):
        loss(batch.clone())
    loss.set_keys(pre_tanh_action="action")
    action = actor(batch.select("state"))["action"]
    magnitude = loss(batch.clone())["pre_tanh_magnitude"]
    torch.testing.assert_close(magnitude, action.square().mean().sqrt().detach())
    free = DDPGLoss(actor, critic, pre_tanh_penalty=0)
    assert set(free.out_keys) == set(free(batch).keys())
