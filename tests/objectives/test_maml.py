"""MAML's losses and gradients against plain policies and critics of one seed and task each."""

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate
from bgpo_trl.objectives.maml import MAMLLoss
from tests.algorithms.playing import perceptron

N_STATES, N_ACTIONS, TASKS = 3, 2, 3


def transitions(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(size):
        return torch.randn(*shape, size, generator=generator, dtype=torch.float64)

    following = {"state": draw(3), "reward": draw(1).gt(1).double(), "terminated": draw(1) > 1}
    data = {"state": draw(3), "action": draw(2).clamp(-1, 1), "next": following}
    return TensorDict(data, shape)


def stack_loss(**arguments):
    """A loss of stacked networks in which all tasks' Q-functions differ, in double precision."""
    arguments = {"inner_learning_rate": 0.1, **arguments}
    network = {"in_keys": ["state"], "hidden_sizes": (8,)}
    generator = torch.Generator().manual_seed(1)
    loss = MAMLLoss(
        Actor(N_STATES, N_ACTIONS, batch_size=[2], generator=generator, **network),
        Actor(N_STATES, N_ACTIONS, batch_size=[2, TASKS], generator=generator, **network),
        Critic(
            *(N_STATES, N_ACTIONS),
            layer_norm=True,
            batch_size=[2, TASKS],
            generator=generator,
            **network,
        ),
        **arguments,
    ).double()
    loss.make_value_estimator(gamma=0.9)
    ForeachSoftUpdate(loss, tau=0.1)
    return loss


def plain_policy_loss(policy, critic, state, penalty):
    pre_tanh = perceptron(policy, state)
    value = perceptron(critic, torch.cat([state, pre_tanh.tanh()], -1), normalize=True)
    return penalty * pre_tanh.square().mean() - value.mean()


def plain_adapted(policy, critic, state, rate, penalty):
    loss = plain_policy_loss(policy, critic, state, penalty)
    gradients = torch.autograd.grad(loss, [*policy.values()], create_graph=True)
    steps = zip(policy.items(), gradients, strict=True)
    return {key: w - rate * gradient for (key, w), gradient in steps}


def by_name(parameters):
    return dict(parameters.flatten_keys(".").items())


def one_of(stack, *index):
    """The weights of one network of a stack, by name."""
    return {key: p[index].detach().clone().requires_grad_() for key, p in stack.items()}


@pytest.mark.parametrize(("rate", "penalty"), [(0.0, 0.1), (0.5, 0.0), (0.5, 0.1)])
def test_the_outer_loss_and_gradient_are_those_of_plain_autograd(rate, penalty):
    """Second derivatives through tanh and layer normalization included."""
    loss = stack_loss(inner_learning_rate=rate, pre_tanh_penalty=penalty)
    meta, critics = dict(loss.meta_network.named_parameters()), by_name(loss.value_network_params)
    batch = transitions(2, TASKS, 8)
    halves = batch["state"].chunk(2, -2)
    ours_adapted = loss.adapt(batch[..., :4])
    value, _ = loss.loss_actor(batch)
    value.backward()
    total = 0.0
    for seed in range(2):
        start = one_of(meta, seed)
        of_seed = 0.0
        for task in range(TASKS):
            critic = one_of(critics, seed, task)
            support, query = (half[seed, task] for half in halves)
            adapted = plain_adapted(start, critic, support, rate, penalty)
            for key, theirs in adapted.items():
                torch.testing.assert_close(ours_adapted[key][seed, task], theirs)
            of_seed = of_seed + plain_policy_loss(adapted, critic, query, penalty)
        gradients = torch.autograd.grad(of_seed, [*start.values()])
        for ours, theirs in zip(meta.values(), gradients, strict=True):
            torch.testing.assert_close(ours.grad[seed], theirs)
        total += of_seed.detach()
    torch.testing.assert_close(value.detach(), total)


def test_the_meta_policy_learns_from_one_loss_and_the_critics_from_the_other():
    loss, batch = stack_loss(inner_learning_rate=0.5), transitions(2, TASKS, 8)
    policies = [*loss.meta_network.parameters()]
    critics = [*loss.value_network_params.parameters()]
    learned = [w for w in loss.parameters() if w.requires_grad]
    assert {*map(id, learned)} == {*map(id, policies + critics)}
    for value, learning in ((loss.loss_actor, policies), (loss.loss_value, critics)):
        loss.zero_grad()
        value(batch)[0].backward()
        for weights in (policies, critics):
            assert all((w.grad is not None) == (weights is learning) for w in weights)


def test_target_actions_are_those_of_a_slow_copy_of_the_adapted_policies():
    loss = stack_loss(inner_learning_rate=0.5)
    target_update = ForeachSoftUpdate(loss, tau=0.25)
    slow = {
        key: w.detach().unsqueeze(1).expand(2, TASKS, *w.shape[1:]).clone()
        for key, w in loss.meta_network.named_parameters()
    }
    for seed in range(3):
        batch = transitions(2, TASKS, 8, seed=seed)
        adapted = loss.adapt(batch[..., :4])
        loss.loss_actor(batch)
        target_update.step()
        slow = {key: 0.75 * w + 0.25 * adapted[key].detach() for key, w in slow.items()}
        with torch.no_grad():
            for w in [*loss.meta_network.parameters(), *loss.value_network_params.parameters()]:
                w += 0.1  # as a step of the optimizer
    torch.testing.assert_close(by_name(loss.target_actor_network_params), slow)

    network = {"in_keys": ["state"], "hidden_sizes": (8,), "batch_size": [2, TASKS]}
    plain = DDPGLoss(
        Actor(N_STATES, N_ACTIONS, **network),
        Critic(N_STATES, N_ACTIONS, layer_norm=True, **network),
    ).double()
    plain.make_value_estimator(gamma=0.9)
    ForeachSoftUpdate(plain, tau=0.1)
    plain.value_network_params.data.copy_(loss.value_network_params.data)
    plain.target_value_network_params.data.copy_(loss.target_value_network_params.data)
    for key, target in by_name(plain.target_actor_network_params).items():
        target.data.copy_(slow[key])
    batch = transitions(2, TASKS, 8, seed=9)
    batch.set("priority_weight", torch.tensor([1.0, 0.0, 1.0]).double().view(3, 1).expand(2, 3, 8))
    value, entries = loss.loss_value(batch)
    expected, plain_entries = plain.loss_value(batch)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(entries["target_value"], plain_entries["target_value"])
    assert entries["target_value"].std() > 0.01


def test_what_does_not_fit_is_refused():
    for meta, adapted, value in (
        ([2], [3, 2], [3, 2]), ([2], [2], [2]), ([], [3], [2]), ([], [], []),
    ):  # fmt: skip
        policies = [Actor(3, batch_size=shape) for shape in (meta, adapted)]
        with pytest.raises(ValueError, match="batch sizes"):
            MAMLLoss(*policies, Critic(3, batch_size=value))
    with pytest.raises(ValueError, match="inner_learning_rate"):
        stack_loss(inner_learning_rate=-0.1)
    with pytest.raises(ValueError, match="even number"):
        stack_loss().loss_actor(transitions(2, TASKS, 7))
