"""The loss against numbers worked out by hand, a plain DDPG, TorchRL's own, and each seed alone."""

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl import objectives

from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.objectives.ddpg import DDPGLoss
from bgpo_trl.objectives.target_update import ForeachSoftUpdate

STATE, ACTION = 6, 4
UNBOUNDED = {"return_bounds": None, "pre_tanh_penalty": 0.0}


def make_loss(generator=None, batch_size=(), **options) -> DDPGLoss:
    networks = {"in_keys": ["state"], "hidden_sizes": (64,)}
    networks |= {"batch_size": batch_size, "generator": generator}
    loss = DDPGLoss(Actor(STATE, ACTION, **networks), Critic(STATE, ACTION, **networks), **options)
    loss.make_value_estimator(gamma=0.98)
    ForeachSoftUpdate(loss, tau=0.005)
    return loss


def make_batch(*shape: int, seed: int = 0, scale: float = 1.0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(*shape, *size, generator=generator) * scale

    terminated = torch.rand(*shape, 1, generator=generator) < 0.2
    next_data = {
        "state": normal(STATE),
        "reward": torch.rand(*shape, 1, generator=generator) * terminated,
        "done": terminated | (torch.rand(*shape, 1, generator=generator) < 0.2),
        "terminated": terminated,
    }
    action = torch.rand(*shape, ACTION, generator=generator) * 2 - 1
    return TensorDict({"state": normal(STATE), "action": action, "next": next_data}, shape)


def total(losses: TensorDict) -> Tensor:
    return losses["loss_actor"] + losses["loss_value"]


def gradients(loss: DDPGLoss, batch: TensorDict) -> list[Tensor]:
    loss.zero_grad()
    total(loss(batch)).backward()
    return [parameter.grad.clone() for parameter in loss.parameters()]


def constant_critic(loss: DDPGLoss, online: float, target: float) -> None:
    """Makes Q equal to ``online`` and the target Q equal to ``target`` everywhere."""
    for parameters, value in (
        (loss.value_network_params, online),
        (loss.target_value_network_params, target),
    ):
        for tensor in parameters.values(True, True):
            tensor.data.zero_()
        parameters["mlp", "layers", "1", "bias"].data.fill_(value)


# reward, done, terminated -> target with gamma 0.98 and a next value of 0.5
TRANSITIONS = [
    (0.0, False, False, 0.49),
    (0.0, True, False, 0.49),  # truncated: the bootstrap goes on
    (0.0, True, True, 0.0),
    (0.3, True, True, 0.3),
    (1.0, False, False, 1.49),
    (-1.0, False, False, -0.51),
]


def transitions() -> tuple[TensorDict, Tensor]:
    reward, done, terminated, target = (torch.tensor(c) for c in zip(*TRANSITIONS, strict=True))
    batch = make_batch(len(TRANSITIONS))
    batch["next", "reward"] = reward.unsqueeze(-1)
    batch["next", "done"] = done.unsqueeze(-1)
    batch["next", "terminated"] = terminated.unsqueeze(-1)
    return batch, target


@pytest.mark.parametrize("bounds", [(), (0.0, 1.1), (-0.2, 0.4)])
def test_target_and_value_loss_by_hand(bounds):
    """Targets are only bounded where bounds are given."""
    loss = make_loss(return_bounds=bounds) if bounds else make_loss()
    constant_critic(loss, online=0.2, target=0.5)
    batch, target = transitions()
    if bounds:
        target = target.clamp(*bounds)
    result = loss(batch)
    torch.testing.assert_close(result["target_value"], target)
    torch.testing.assert_close(result["pred_value"], torch.full_like(target, 0.2))
    torch.testing.assert_close(result["loss_value"], (0.2 - target).square().mean())
    torch.testing.assert_close(batch["td_error"], (0.2 - target).square())
    torch.testing.assert_close(result["td_error_max"], (0.2 - target).square().max())
    torch.testing.assert_close(result["target_value_max"], target.max())
    assert result["pred_value_max"].item() == pytest.approx(0.2)


def test_rewards_of_any_range_are_learned_by_default():
    loss = make_loss()
    constant_critic(loss, online=0.0, target=-100.0)
    batch, _ = transitions()
    batch["next", "reward"].fill_(-16.0)  # as Pendulum's may be
    target = torch.where(batch["next", "terminated"], -16.0, -16.0 - 0.98 * 100).squeeze(-1)
    torch.testing.assert_close(loss(batch)["target_value"], target)


def test_gamma_is_set_by_the_value_estimator():
    loss = make_loss()
    constant_critic(loss, online=0.0, target=0.5)
    loss.make_value_estimator(objectives.ValueEstimators.TD0, gamma=0.5)
    assert loss(transitions()[0])["target_value"][0].item() == pytest.approx(0.25)
    with pytest.raises(NotImplementedError):
        loss.make_value_estimator(objectives.ValueEstimators.TDLambda)


def test_demonstrated_actions_alone_are_imitated():
    """With a flat Q, the actor's loss is -Q plus the weighted distance, by hand."""
    batch = make_batch(6)
    loss = make_loss(pre_tanh_penalty=0.0, imitation=2.0)
    constant_critic(loss, online=0.3, target=0.3)
    torch.testing.assert_close(loss(batch)["loss_actor"], torch.tensor(-0.3))
    batch["demonstrated"] = torch.arange(6) >= 4
    action = loss.actor_network(batch.clone())["action"]
    distance = (action - batch["action"])[4:].square().sum()
    torch.testing.assert_close(loss(batch)["loss_actor"], -0.3 + 2.0 * distance / 6)


def test_penalty_is_the_gradient_left_when_q_is_flat():
    batch = make_batch(8)
    for penalty in (0.01, 0.0):
        loss = make_loss(pre_tanh_penalty=penalty)
        constant_critic(loss, online=0.3, target=0.3)
        pre_tanh = loss.actor_network(batch.clone())["pre_tanh_action"]
        result = loss(batch)
        expected = -0.3 + penalty * pre_tanh.square().mean()
        torch.testing.assert_close(result["loss_actor"], expected)
        torch.testing.assert_close(
            result["pre_tanh_magnitude"], pre_tanh.square().mean().sqrt().detach()
        )
        result["loss_actor"].backward()
        output_bias = loss.actor_network_params["mlp", "layers", "1", "bias"]
        expected = (2 * penalty * pre_tanh / pre_tanh.numel()).sum(0).detach()
        torch.testing.assert_close(output_bias.grad, expected)


class PlainDDPG:
    """DDPG in plain torch, sharing nothing with the code under test but the initial weights."""

    def __init__(self, loss: DDPGLoss):
        self.actor = self.copy(loss.actor_network, nn.Tanh())
        self.critic = self.copy(loss.value_network)
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critic = copy.deepcopy(self.critic)
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=1e-3)

    @staticmethod
    def copy(network: nn.Module, *output: nn.Module) -> nn.Sequential:
        w1, b1, w2, b2 = (parameter.detach() for parameter in network.parameters())
        plain = nn.Sequential(nn.Linear(*w1.shape), nn.ReLU(), nn.Linear(*w2.shape), *output)
        for parameter, value in zip(plain.parameters(), (w1.T, b1, w2.T, b2), strict=True):
            parameter.data = value.clone()
        return plain

    def losses(self, batch: TensorDict) -> tuple[Tensor, Tensor]:
        state, action, successor = batch["state"], batch["action"], batch["next"]
        with torch.no_grad():
            next_action = self.target_actor(successor["state"])
            next_q = self.target_critic(torch.cat([successor["state"], next_action], -1))
            target = successor["reward"] + 0.98 * next_q * (~successor["terminated"]).float()
            target = target.clip(0.0, 1.1)
        q = self.critic(torch.cat([state, action], -1))
        value_loss = ((q - target) ** 2).mean()
        pre_tanh = self.actor[:-1](state)
        q = self.critic(torch.cat([state, pre_tanh.tanh()], -1))
        return -q.mean() + 0.01 * (pre_tanh**2).mean(), value_loss

    def update(self, batch: TensorDict) -> None:
        actor_loss, value_loss = self.losses(batch)
        actor, critic = list(self.actor.parameters()), list(self.critic.parameters())
        actor_grads = torch.autograd.grad(actor_loss, actor)
        critic_grads = torch.autograd.grad(value_loss, critic)
        for parameter, grad in zip(actor + critic, actor_grads + critic_grads, strict=True):
            parameter.grad = grad
        self.optimizer.step()
        for network, target in (
            (self.actor, self.target_actor),
            (self.critic, self.target_critic),
        ):
            for source, slow in zip(network.parameters(), target.parameters(), strict=True):
                slow.data = 0.995 * slow.data + 0.005 * source.data


def test_trains_as_a_plain_ddpg_does():
    loss = make_loss(torch.Generator().manual_seed(1), return_bounds=(0.0, 1.1))
    update = ForeachSoftUpdate(loss, tau=0.005)
    plain = PlainDDPG(loss)
    optimizer = torch.optim.Adam(list(loss.parameters()), lr=1e-3)
    for step in range(50):
        batch = make_batch(32, seed=step)
        result, (actor_loss, value_loss) = loss(batch), plain.losses(batch)
        torch.testing.assert_close(result["loss_actor"], actor_loss, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(result["loss_value"], value_loss, rtol=1e-4, atol=1e-5)
        optimizer.zero_grad()
        total(result).backward()
        optimizer.step()
        update.step()
        plain.update(batch)
    for network, reference in (
        (loss.actor_network_params, plain.actor),
        (loss.value_network_params, plain.critic),
        (loss.target_actor_network_params, plain.target_actor),
        (loss.target_value_network_params, plain.target_critic),
    ):
        for mine, theirs in zip(network.values(True, True), reference.parameters(), strict=True):
            theirs = theirs.T if theirs.ndim == 2 else theirs
            torch.testing.assert_close(mine.data, theirs.data, rtol=1e-4, atol=2e-5)


def test_without_options_it_is_torchrls_loss():
    loss = make_loss(**UNBOUNDED)
    reference = objectives.DDPGLoss(
        copy.deepcopy(loss.actor_network), copy.deepcopy(loss.value_network), delay_actor=True
    )
    reference.make_value_estimator(objectives.ValueEstimators.TD0, gamma=0.98)
    objectives.SoftUpdate(reference, tau=0.005)
    batch = make_batch(16)
    mine, theirs = loss(batch.clone()), reference(batch.clone())
    for key in ("loss_actor", "loss_value", "pred_value", "target_value", "target_value_max"):
        torch.testing.assert_close(mine[key], theirs[key])
    total(theirs).backward()
    for parameter, grad in zip(reference.parameters(), gradients(loss, batch), strict=True):
        torch.testing.assert_close(parameter.grad, grad)


def test_neither_network_learns_from_the_others_loss():
    loss = make_loss()
    actor = list(loss.actor_network_params.parameters())
    critic = list(loss.value_network_params.parameters())
    for key, learning, still in (
        ("loss_actor", actor, critic),
        ("loss_value", critic, actor),
    ):
        loss.zero_grad()
        loss(make_batch(16))[key].backward()
        assert all(parameter.grad.abs().sum() > 0 for parameter in learning)
        assert all(parameter.grad is None for parameter in still)


def test_stacked_seeds_are_each_seed_alone():
    n_seeds = 3
    stacked = make_loss(
        [torch.Generator().manual_seed(seed) for seed in range(n_seeds)], (n_seeds,)
    )
    alone = [make_loss(torch.Generator().manual_seed(seed)) for seed in range(n_seeds)]
    losses = [stacked, *alone]
    optimizers = [torch.optim.Adam(list(loss.parameters()), lr=1e-3) for loss in losses]
    updates = [ForeachSoftUpdate(loss, tau=0.005) for loss in losses]
    for step in range(50):
        batch = make_batch(n_seeds, 32, seed=step)
        batches = [batch, *batch.unbind(0)]
        results = [loss(data) for loss, data in zip(losses, batches, strict=True)]
        for key in ("loss_actor", "loss_value"):
            torch.testing.assert_close(
                results[0][key], sum(r[key] for r in results[1:]), rtol=1e-4, atol=1e-5
            )
        for key in ("td_error_max", "pre_tanh_magnitude", "target_value", "pred_value_max"):
            expected = torch.stack([r[key] for r in results[1:]])
            torch.testing.assert_close(results[0][key], expected, rtol=1e-4, atol=1e-5)
        for loss, data, optimizer, update in zip(losses, batches, optimizers, updates, strict=True):
            grads = gradients(loss, data)
            if step == 0:
                if loss is stacked:
                    stacked_grads = grads
                else:
                    seed = losses.index(loss) - 1
                    for together, grad in zip(stacked_grads, grads, strict=True):
                        torch.testing.assert_close(together[seed], grad)
            optimizer.step()
            update.step()
    for seed, loss in enumerate(alone):
        state = stacked.state_dict()
        for key, value in loss.state_dict().items():
            together = state[key] if state[key].ndim == value.ndim else state[key][seed]
            torch.testing.assert_close(together, value, rtol=1e-4, atol=2e-5)


def test_targets_stay_attainable_on_data_that_makes_them_diverge():
    def largest_target(**options) -> float:
        loss = make_loss(torch.Generator().manual_seed(0), **options)
        update = ForeachSoftUpdate(loss, tau=0.5)
        optimizer = torch.optim.Adam(list(loss.parameters()), lr=1e-2)
        batch = make_batch(64, scale=10)
        batch["next", "reward"].fill_(1.0)
        batch["next", "terminated"].fill_(False)
        largest = 0.0
        for _ in range(100):
            result = loss(batch)
            largest = max(largest, result["target_value"].abs().max().item())
            optimizer.zero_grad()
            total(result).backward()
            optimizer.step()
            update.step()
        return largest

    assert largest_target(**UNBOUNDED) > 10
    assert largest_target(return_bounds=(0.0, 1.1)) <= torch.tensor(1.1)


def test_learns_a_point_task():
    generator = torch.Generator().manual_seed(0)
    networks = {"in_keys": ["state"], "hidden_sizes": (64,), "generator": generator}
    actor = Actor(1, 1, **networks)
    loss = DDPGLoss(actor, Critic(1, 1, **networks))
    update = ForeachSoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(list(loss.parameters()), lr=3e-3, fused=True)

    def reward(state: Tensor, action: Tensor) -> Tensor:
        return torch.exp(-4 * (action + 0.7 * state).square())

    def mean_return() -> float:
        state = torch.linspace(-1, 1, 101).unsqueeze(-1)
        return reward(state, actor(TensorDict({"state": state}, [101]))["action"]).mean().item()

    before = mean_return()
    for _ in range(400):
        state, action = (torch.rand(2, 128, 1, generator=generator) * 2 - 1).unbind(0)
        ended = torch.ones(128, 1, dtype=torch.bool)
        successor = {"state": state, "done": ended, "terminated": ended}
        successor["reward"] = reward(state, action)
        result = loss(TensorDict({"state": state, "action": action, "next": successor}, [128]))
        optimizer.zero_grad()
        total(result).backward()
        optimizer.step()
        update.step()
    assert before < 0.7
    assert mean_return() > 0.9


def test_constant_entry_is_not_needed_under_next():
    networks = {"in_keys": ["state", "behavior"]}
    actor, critic = Actor(STATE + 2, ACTION, **networks), Critic(STATE + 2, ACTION, **networks)
    plain, lean = DDPGLoss(actor, critic), DDPGLoss(actor, critic, constant_keys=["behavior"])
    for loss in (plain, lean):
        ForeachSoftUpdate(loss, tau=0.005)
    batch = make_batch(16)
    batch["behavior"] = torch.randn(16, 2)
    with pytest.raises(ValueError, match=r"^DDPGLoss, under 'next', found no 'behavior'"):
        plain(batch)
    result = lean(batch)
    batch["next", "behavior"] = batch["behavior"]
    torch.testing.assert_close(result["target_value"], plain(batch)["target_value"])


def test_soft_update_is_torchrls_also_after_a_cast():
    losses = [make_loss(torch.Generator().manual_seed(0)) for _ in range(2)]
    mine = ForeachSoftUpdate(losses[0], tau=0.1)
    theirs = objectives.SoftUpdate(losses[1], tau=0.1)
    before = losses[0].state_dict()["target_value_network_params.mlp.layers.0.weight"].clone()
    for loss in losses:
        loss.double()
        for parameter in loss.parameters():
            parameter.data.add_(1.0)
    for _ in range(3):
        mine.step()
        theirs.step()
    expected = losses[1].state_dict()
    for key, value in losses[0].state_dict().items():
        torch.testing.assert_close(value, expected[key])
    after = losses[0].state_dict()["target_value_network_params.mlp.layers.0.weight"]
    torch.testing.assert_close(after - before, torch.full_like(after, 1 - 0.9**3))


@pytest.mark.parametrize("change", [copy.deepcopy, lambda loss: loss.double().float()])
def test_a_copied_or_cast_loss_still_follows_its_parameters(change):
    loss, batch = make_loss(torch.Generator().manual_seed(0)), make_batch(16)
    loss(batch)  # what it keeps from a first call must not outlive the change
    loss = change(loss)
    fresh = make_loss(torch.Generator().manual_seed(1))
    fresh(batch)
    loss.load_state_dict(fresh.state_dict())
    mine, theirs = loss(batch), fresh(batch)
    for key in ("loss_actor", "loss_value", "target_value"):
        torch.testing.assert_close(mine[key], theirs[key])
    for grad, other in zip(gradients(loss, batch), gradients(fresh, batch), strict=True):
        torch.testing.assert_close(grad, other)


def test_importance_weights_scale_each_transition():
    loss = make_loss()
    batch = make_batch(8)
    distance = loss(batch.clone())
    distance = (distance["pred_value"] - distance["target_value"]).square()
    weights = torch.linspace(0, 2, 8)
    weighted = loss(batch.set("priority_weight", weights))["loss_value"]
    torch.testing.assert_close(weighted, (weights * distance).mean())


def test_targets_of_several_steps_are_discounted_as_often():
    loss, batch = make_loss(), make_batch(8)
    constant_critic(loss, online=0.0, target=0.5)
    steps = torch.arange(1, 9).unsqueeze(-1)
    batch["next", "terminated"].zero_()
    target = loss(batch.set("steps_to_next_obs", steps))["target_value"]
    expected = batch["next", "reward"] + 0.5 * 0.98**steps
    torch.testing.assert_close(target, expected.squeeze(-1))


def test_weights_count_only_if_they_are_used():
    loss, batch = make_loss(), make_batch(8)
    batch["priority_weight"] = torch.linspace(0, 2, 8)
    told = loss(batch)
    loss.use_prioritized_weights = False
    error = (told["pred_value"] - told["target_value"]).square()
    torch.testing.assert_close(loss(batch)["loss_value"], error.mean())


@pytest.mark.parametrize("shape", [[2], [2, 8, 1], [8]])
def test_weights_are_one_a_transition(shape):
    networks = {"in_keys": ["state"], "batch_size": (2,)}
    loss = DDPGLoss(Actor(STATE, ACTION, **networks), Critic(STATE, ACTION, **networks))
    ForeachSoftUpdate(loss, tau=0.005)
    weights = torch.ones(shape)
    data = TensorDict(dict(make_batch(2, 8).items()), [])
    with pytest.raises(ValueError, match=r"must be one weight a transition, \[2, 8\], got"):
        loss(data.set("priority_weight", weights))


def test_networks_follow_their_mode_after_the_first_call():
    class Dropping(Actor):
        def __init__(self) -> None:
            super().__init__(STATE, ACTION, in_keys=["state"])
            self.drop = torch.nn.Dropout(0.5)

        def forward(self, tensordict):
            hidden = self.drop(tensordict["state"])
            return super().forward(tensordict.set("state", hidden))

    torch.manual_seed(0)
    loss = DDPGLoss(Dropping(), Critic(STATE, ACTION, in_keys=["state"]))
    ForeachSoftUpdate(loss, tau=0.005)
    batch = make_batch(8)

    def losses():
        return [loss(batch.clone())["loss_actor"].item() for _ in range(2)]

    assert len({*losses()}) == 2
    loss.actor_network.eval()
    assert len({*losses()}) == 1
    loss.actor_network.train()
    assert len({*losses()}) == 2


def stack_with_weights(n_seeds: int, weights: Tensor | None, n_rows: int = 32, **critic):
    """Gradients of a stack of seeds, one tensor for each layer, and what the loss tells."""
    streams = [torch.Generator().manual_seed(seed) for seed in range(n_seeds)]
    networks = {"in_keys": ["state"], "batch_size": (n_seeds,), "generator": streams}
    loss = DDPGLoss(Actor(STATE, ACTION, **networks), Critic(STATE, ACTION, **networks, **critic))
    loss.make_value_estimator(gamma=0.98)
    ForeachSoftUpdate(loss, tau=0.005)
    batch = make_batch(n_seeds, n_rows)
    if weights is not None:
        batch["priority_weight"] = weights.unsqueeze(-1).expand(n_seeds, n_rows).clone()
    return gradients(loss, batch), loss(batch)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_seeds_of_weight_zero_have_no_gradient_and_change_no_others(layer_norm):
    everything, _ = stack_with_weights(4, None, layer_norm=layer_norm)
    weights = torch.tensor([1.0, 0.0, 1.0, 0.0])
    weighted, told = stack_with_weights(4, weights, layer_norm=layer_norm)
    assert len(weighted) == 12  # weight and bias of three layers of both networks
    for grad, unweighted in zip(weighted, everything, strict=True):
        assert not grad[[1, 3]].any()
        assert grad[[0, 2]].equal(unweighted[[0, 2]])
        assert unweighted[[1, 3]].abs().flatten(1).amax(-1).min() > 0
    ones, told_of_ones = stack_with_weights(4, torch.ones(4), layer_norm=layer_norm)
    for grad, unweighted in zip(ones, everything, strict=True):
        assert grad.equal(unweighted)
    assert told["pre_tanh_magnitude"].equal(told_of_ones["pre_tanh_magnitude"])


def test_weights_count_in_the_actors_loss_and_in_its_penalty():
    loss, batch = make_loss(pre_tanh_penalty=0.5), make_batch(8)
    weights = torch.linspace(0, 2, 8)
    data = loss.actor_network(batch.select("state"))
    value = loss.value_network(data)["state_action_value"].squeeze(-1)
    penalty = 0.5 * data["pre_tanh_action"].square().mean(-1)
    result = loss(batch.set("priority_weight", weights))
    torch.testing.assert_close(result["loss_actor"], (weights * (penalty - value)).mean())
    # A flat critic leaves the penalty alone.
    constant_critic(loss, online=0.3, target=0.3)
    loss.zero_grad()
    loss(batch)["loss_actor"].backward()
    pre_tanh = data["pre_tanh_action"].detach()
    expected = (weights.unsqueeze(-1) * 2 * 0.5 * pre_tanh / pre_tanh.numel()).sum(0)
    bias = loss.actor_network_params["mlp", "layers", "1", "bias"]
    torch.testing.assert_close(bias.grad, expected)


def test_rows_of_zeros_and_weight_zero_learn_nothing_under_layer_norm():
    """`GroupReplay` returns such rows for tasks without data."""
    networks = {"in_keys": ["state"], "batch_size": (2,)}
    loss = DDPGLoss(
        Actor(STATE, ACTION, **networks), Critic(STATE, ACTION, layer_norm=True, **networks)
    )
    ForeachSoftUpdate(loss, tau=0.005)
    batch = make_batch(2, 16).set("priority_weight", torch.ones(2, 16))
    batch[1] = batch[1].apply(torch.zeros_like)
    for grad in gradients(loss, batch):
        assert torch.isfinite(grad).all()
        assert grad[0].any()
        assert not grad[1].any()


def test_an_actor_of_another_kind():
    network = TensorDictModule(nn.Linear(STATE, ACTION), in_keys=["state"], out_keys=["action"])
    loss = DDPGLoss(network, Critic(STATE, ACTION, in_keys=["state"]))
    ForeachSoftUpdate(loss, tau=0.005)
    with pytest.raises(ValueError, match="pre_tanh_penalty=0"):
        loss(make_batch(4))
    loss.set_keys(pre_tanh_action="action")
    action = network(make_batch(4).exclude("action"))["action"]
    magnitude = loss(make_batch(4))["pre_tanh_magnitude"]
    torch.testing.assert_close(magnitude, action.square().mean().sqrt().detach())
    free = DDPGLoss(network, Critic(STATE, ACTION, in_keys=["state"]), pre_tanh_penalty=0)
    ForeachSoftUpdate(free, tau=0.005)
    assert torch.isfinite(total(free(make_batch(4))))


def test_truncation_is_told_by_terminated_alone():
    loss, batch = make_loss(), make_batch(16)
    expected = loss(batch.clone())["target_value"]
    assert torch.equal(loss(batch.exclude(("next", "done")))["target_value"], expected)
    with pytest.raises(ValueError, match=r"lacks .*terminated"):
        loss(batch.exclude(("next", "terminated")))


@pytest.mark.parametrize(
    "options",
    [{"return_bounds": (1.0, 1.0)}, {"pre_tanh_penalty": -1.0}, {"pre_tanh_penalty": float("nan")}],
)
def test_bad_options_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        make_loss(**options)
