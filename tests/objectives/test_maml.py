"""MAML's losses and gradients against plain policies and critics of one seed and task each."""

import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import layer_norm

from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate
from bgpo_trl.objectives.maml import MAMLLoss

N_STATES, N_ACTIONS, TASKS = 3, 2, 3


def transitions(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(size):
        return torch.randn(*shape, size, generator=generator, dtype=torch.float64)

    following = {"state": draw(3), "reward": draw(1).gt(1).double(), "terminated": draw(1) > 1}
    data = {"state": draw(3), "action": draw(2).clamp(-1, 1), "next": following}
    return TensorDict(data, shape)


def stack_loss(n_seeds=2, **arguments):
    """A loss of stacked networks in which all tasks' Q-functions differ, in double precision."""
    arguments = {"inner_learning_rate": 0.1, **arguments}
    stack = [] if n_seeds is None else [n_seeds]
    network = {"in_keys": ["state"], "hidden_sizes": (8,)}
    generator = torch.Generator().manual_seed(1)
    loss = MAMLLoss(
        Actor(N_STATES, N_ACTIONS, batch_size=stack, generator=generator, **network),
        Actor(N_STATES, N_ACTIONS, batch_size=[*stack, TASKS], generator=generator, **network),
        Critic(
            *(N_STATES, N_ACTIONS),
            layer_norm=True,
            batch_size=[*stack, TASKS],
            generator=generator,
            **network,
        ),
        **arguments,
    ).double()
    loss.make_value_estimator(gamma=0.9)
    ForeachSoftUpdate(loss, tau=0.1)
    return loss


def plain_policy(weights, state):
    first, first_bias, second, second_bias = weights
    return (state @ first + first_bias).relu() @ second + second_bias


def plain_critic(weights, state, action):
    first, first_bias, second, second_bias = weights
    hidden = torch.cat([state, action], -1) @ first + first_bias
    return layer_norm(hidden, hidden.shape[-1:]).relu() @ second + second_bias


def plain_policy_loss(policy, critic, state, penalty):
    pre_tanh = plain_policy(policy, state)
    value = plain_critic(critic, state, pre_tanh.tanh())
    return penalty * pre_tanh.square().mean() - value.mean()


def plain_adapted(policy, critic, state, rate, penalty):
    loss = plain_policy_loss(policy, critic, state, penalty)
    gradients = torch.autograd.grad(loss, policy, create_graph=True)
    return [w - rate * gradient for w, gradient in zip(policy, gradients, strict=True)]


def one_of(parameters, *index):
    """The weights of one network of a stack, layer by layer, each matrix before its bias."""
    return [p[index].detach().clone().requires_grad_() for p in parameters]


def ordered(parameters):
    """The values of a tensordict of parameters or of a dict of them, as `one_of` wants them."""
    flat = parameters if isinstance(parameters, dict) else parameters.flatten_keys(".")
    return [flat[f"mlp.layers.{i}.{name}"] for i in range(2) for name in ("weight", "bias")]


@pytest.mark.parametrize(("rate", "penalty"), [(0.0, 0.1), (0.5, 0.0), (0.5, 0.1)])
def test_the_outer_loss_and_gradient_are_those_of_plain_autograd(rate, penalty):
    """Second derivatives through tanh and layer normalization included."""
    loss = stack_loss(inner_learning_rate=rate, pre_tanh_penalty=penalty)
    batch = transitions(2, TASKS, 8)
    halves = batch["state"].chunk(2, -2)
    support_batch = batch[..., :4]
    ours_adapted = ordered(loss.adapt(support_batch))
    value, _ = loss.loss_actor(batch)
    value.backward()
    total = 0.0
    for seed in range(2):
        start = one_of(loss.meta_network.parameters(), seed)
        of_seed = 0.0
        for task in range(TASKS):
            critic = one_of(loss.value_network_params.parameters(), seed, task)
            support, query = (half[seed, task] for half in halves)
            adapted = plain_adapted(start, critic, support, rate, penalty)
            for ours, theirs in zip(ours_adapted, adapted, strict=True):
                torch.testing.assert_close(ours[seed, task], theirs)
            of_seed = of_seed + plain_policy_loss(adapted, critic, query, penalty)
        gradients = torch.autograd.grad(of_seed, start)
        for ours, theirs in zip(loss.meta_network.parameters(), gradients, strict=True):
            torch.testing.assert_close(ours.grad[seed], theirs)
        total += of_seed.detach()
    torch.testing.assert_close(value.detach(), total)


def test_target_actions_are_those_of_a_slow_copy_of_the_adapted_policies():
    loss = stack_loss(inner_learning_rate=0.5)
    target_update = ForeachSoftUpdate(loss, tau=0.25)
    slow = [
        w.detach().unsqueeze(1).expand(2, TASKS, *w.shape[1:]).clone()
        for w in loss.meta_network.parameters()
    ]
    for seed in range(3):
        batch = transitions(2, TASKS, 8, seed=seed)
        adapted = ordered(loss.adapt(batch[..., :4]))
        loss.loss_actor(batch)
        target_update.step()
        slow = [0.75 * w + 0.25 * a.detach() for w, a in zip(slow, adapted, strict=True)]
        with torch.no_grad():
            for w in [*loss.meta_network.parameters(), *loss.value_network_params.parameters()]:
                w += 0.1  # as a step of the optimizer
    for ours, theirs in zip(ordered(loss.target_actor_network_params), slow, strict=True):
        torch.testing.assert_close(ours, theirs)

    network = {"in_keys": ["state"], "hidden_sizes": (8,), "batch_size": [2, TASKS]}
    plain = DDPGLoss(
        Actor(N_STATES, N_ACTIONS, **network),
        Critic(N_STATES, N_ACTIONS, layer_norm=True, **network),
    ).double()
    plain.make_value_estimator(gamma=0.9)
    ForeachSoftUpdate(plain, tau=0.1)
    plain.value_network_params.data.copy_(loss.value_network_params.data)
    plain.target_value_network_params.data.copy_(loss.target_value_network_params.data)
    for ours, theirs in zip(ordered(plain.target_actor_network_params), slow, strict=True):
        ours.data.copy_(theirs)
    batch = transitions(2, TASKS, 8, seed=9)
    batch.set("priority_weight", torch.tensor([1.0, 0.0, 1.0]).double().view(3, 1).expand(2, 3, 8))
    value, entries = loss.loss_value(batch)
    expected, plain_entries = plain.loss_value(batch)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(entries["target_value"], plain_entries["target_value"])
    assert entries["target_value"].std() > 0.01


def test_the_actors_loss_stores_the_adapted_policies_and_trains_the_meta_policy_only():
    loss = stack_loss(inner_learning_rate=0.5)
    batch = transitions(2, TASKS, 8)
    expected = ordered(loss.adapt(batch[..., :4]))
    loss.loss_actor(batch)[0].backward()
    for ours, theirs in zip(ordered(loss.actor_network_params), expected, strict=True):
        torch.testing.assert_close(ours.detach(), theirs.detach())
        assert not ours.requires_grad
        assert ours.grad is None
    assert all(w.grad is None for w in loss.value_network_params.parameters())
    assert all(w.grad.abs().sum() > 0 for w in loss.meta_network.parameters())

    learned = [w for w in loss.parameters() if w.requires_grad]
    meant = [*loss.meta_network.parameters(), *loss.value_network_params.parameters()]
    assert {id(w) for w in learned} == {id(w) for w in meant}
    assert len(learned) == 8
    loss.zero_grad()
    loss.loss_value(batch)[0].backward()
    assert all(w.grad.abs().sum() > 0 for w in loss.value_network_params.parameters())
    assert all(w.grad is None for w in loss.meta_network.parameters())


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
