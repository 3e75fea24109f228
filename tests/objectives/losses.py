"""Small losses of every kind, with batches of transitions for them."""

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate

SIZES = {"state": 6, "label": 2}
STATE, ACTION = SIZES["state"], 4
N_CRITICS = {"ddpg": 1, "ensemble": 3, "clone": 3}
every_loss = pytest.mark.parametrize("name", N_CRITICS)


def stream(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_loss(name, seeds=(0,), *, stacked=False, in_keys=("state",), layer_norm=False, **options):
    """Make a loss of one seed, or of a stack of seeds; a seed starts the same in either."""
    shape, n_critics = [len(seeds)] if stacked else [], N_CRITICS[name]
    size = sum(SIZES[key] for key in in_keys)
    network = {"in_keys": list(in_keys), "hidden_sizes": (16,)}

    def actor(first: int) -> Actor:
        streams = [stream(seed + first) for seed in seeds]
        return Actor(size, ACTION, batch_size=shape, generator=streams, **network)

    critic = Critic(
        size,
        ACTION,
        layer_norm=layer_norm,
        batch_size=[*shape, *([n_critics] if n_critics > 1 else [])],
        generator=[stream(100 * (seed + 1) + i) for seed in seeds for i in range(n_critics)],
        **network,
    )
    options["n_critics"] = n_critics
    loss = DDPGLoss(actor(0), critic, actor(50) if name == "clone" else None, **options)
    loss.make_value_estimator(gamma=0.98)
    ForeachSoftUpdate(loss, tau=0.005)
    return loss


def make_batch(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> TensorDict:
    generator = stream(seed)

    def normal(size: int) -> Tensor:
        return torch.randn(*shape, size, generator=generator).to(dtype)

    def inputs() -> dict[str, Tensor]:
        return {key: normal(size) for key, size in SIZES.items()}

    def acted() -> dict[str, Tensor]:
        return {**inputs(), "action": normal(ACTION).clamp(-1, 1)}

    terminated = torch.rand(*shape, 1, generator=generator) < 0.2
    truncated = torch.rand(*shape, 1, generator=generator) < 0.2
    reward = torch.rand(*shape, 1, generator=generator).to(dtype) * terminated
    following = {"reward": reward, "done": terminated | truncated, "terminated": terminated}
    following |= inputs()
    return TensorDict({**acted(), "imitation": acted(), "next": following}, shape)


def total(losses: TensorDict) -> Tensor:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def gradients(loss, batch: TensorDict) -> list[Tensor]:
    loss.zero_grad()
    total(loss(batch)).backward()
    return [parameter.grad.clone() for parameter in loss.parameters()]


def constant_critics(loss, online, target) -> None:
    """Make Q equal to ``online`` and target Q to ``target`` everywhere; triples for ensembles."""
    for parameters, values in (
        (loss.value_network_params, online),
        (loss.target_value_network_params, target),
    ):
        for tensor in parameters.values(True, True):
            tensor.data.zero_()
        bias = parameters["mlp", "layers", "1", "bias"]
        bias.data.copy_(torch.tensor(values).unsqueeze(-1))
