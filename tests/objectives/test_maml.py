"""MAML's gradients against finite differences and hand-made cases."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn

from bgpo_trl.objectives.ddpg import ForeachSoftUpdate
from bgpo_trl.objectives.maml import MAMLLoss

TARGETS = torch.tensor([[0.5, -0.2], [-0.7, 0.9], [0.1, 0.4]]).double()


class Linear(TensorDictModuleBase):
    """A policy ``action = state @ weight``, without a tanh."""

    def __init__(self, batch_size=()):
        super().__init__()
        self.batch_size = torch.Size(batch_size)
        self.in_keys, self.out_keys = ["state"], ["pre_tanh_action", "action"]
        generator = torch.Generator().manual_seed(0)
        self.weight = nn.Parameter(torch.randn(*batch_size, 3, 2, generator=generator).double())

    def forward(self, tensordict):
        action = tensordict["state"] @ self.weight
        return tensordict.set("pre_tanh_action", action).set("action", action)


class Quadratic(TensorDictModuleBase):
    """``Q_i(s, a) = -1/2 |a - target_i|^2``: each task wants another action everywhere."""

    def __init__(self, targets):
        super().__init__()
        self.batch_size = targets.shape[:-1]
        self.in_keys, self.out_keys = ["state", "action"], ["state_action_value"]
        self.target = nn.Parameter(targets.clone())

    def forward(self, tensordict):
        error = tensordict["action"] - self.target.unsqueeze(-2)
        value = -0.5 * error.square().sum(-1, keepdim=True)
        return tensordict.set("state_action_value", value)


def transitions(*shape, n_states=3, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)

    def draw(size):
        return torch.randn(*shape, size, generator=generator, dtype=torch.float64).to(dtype)

    return TensorDict(
        {
            "state": draw(n_states),
            "action": draw(2).clamp(-1, 1),
            "next": {
                "state": draw(n_states),
                "reward": draw(1).gt(1).to(dtype),
                "terminated": draw(1) > 1,
            },
        },
        shape,
    )


def quadratic_loss(**arguments):
    loss = MAMLLoss(Linear(), Linear([3]), Quadratic(TARGETS), **arguments)
    ForeachSoftUpdate(loss, tau=0.1)
    return loss


def plain_loss(weight, batch, rate, penalty):
    """The outer loss of a linear policy, with the inner gradient worked out by hand."""
    support, query = batch.chunk(2, dim=-1)
    total = 0.0
    for task, target in enumerate(TARGETS):
        x = support["state"][task]
        error = x @ weight - target
        gradient = x.T @ (error + penalty * x @ weight) / len(x)
        adapted = weight - rate * gradient
        y = query["state"][task] @ adapted
        value = 0.5 * (y - target).square().sum(-1).mean() + penalty * y.square().mean()
        total = total + value
    return total


@pytest.mark.parametrize("rate", [0.0, 0.3])
@pytest.mark.parametrize("penalty", [0.0, 0.2])
def test_the_outer_gradient_is_that_of_finite_differences(rate, penalty):
    batch = transitions(3, 8)
    loss = quadratic_loss(inner_learning_rate=rate, pre_tanh_penalty=penalty)
    meta = loss.meta_network.weight
    value, _ = loss.loss_actor(batch)
    value.backward()

    start = meta.detach().clone()
    torch.testing.assert_close(value.detach(), plain_loss(start, batch, rate, penalty))
    numeric, step = torch.zeros_like(start), 1e-5
    for row in range(3):
        for column in range(2):
            nudge = torch.zeros_like(start)
            nudge[row, column] = step
            up, down = (plain_loss(start + s * nudge, batch, rate, penalty) for s in (1, -1))
            numeric[row, column] = (up - down) / (2 * step)
    torch.testing.assert_close(meta.grad, numeric, rtol=1e-6, atol=1e-8)
