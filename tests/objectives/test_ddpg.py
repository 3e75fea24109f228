"""The DDPG loss: imitation and penalty by hand, and training beside a plain DDPG."""

import copy

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from bgpo_trl.objectives.ddpg import DDPGLoss
from bgpo_trl.objectives.off_policy import ForeachSoftUpdate
from tests.objectives.losses import (
    constant_critics,
    make_batch,
    make_loss,
    total,
)


def test_only_demonstrated_actions_are_imitated():
    """With a flat Q, the actor's loss is -Q plus the weighted distance, by hand."""
    batch = make_batch(6)
    loss = make_loss("ddpg", pre_tanh_penalty=0.0, imitation=2.0)
    constant_critics(loss, online=0.3, target=0.3)
    torch.testing.assert_close(loss(batch)["loss_actor"], torch.tensor(-0.3))
    batch["demonstrated"] = torch.arange(6) >= 4
    action = loss.actor_network(batch.clone())["action"]
    distance = (action - batch["action"])[4:].square().sum()
    torch.testing.assert_close(loss(batch)["loss_actor"], -0.3 + 2.0 * distance / 6)


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
    loss = make_loss("ddpg", return_bounds=(0.0, 1.1))
    update = ForeachSoftUpdate(loss, tau=0.005)
    plain = PlainDDPG(loss)
    optimizer = torch.optim.Adam(list(loss.parameters()), lr=1e-3)
    for step in range(30):
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
