"""Behavior-Guided Policy Optimization (Alg. 1): GWR-B tells the task, DDPG learns to do it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs import (
    ClipTransform,
    Compose,
    ObservationNorm,
    RenameTransform,
    RewardSum,
    StepCounter,
    Transform,
    TransformedEnv,
    UnaryTransform,
)

from bgpo_trl.configs import BGPOConfig
from bgpo_trl.demonstrations import DemonstrationBank
from bgpo_trl.envs import NicoEnv
from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate
from bgpo_trl.replay import ReplayBuffer
from bgpo_trl.representation import Representation
from bgpo_trl.seeding import generators, stream_seed
from bgpo_trl.transforms import (
    BehaviorLookup,
    BehaviorMatchingReward,
    DemonstrationSource,
    FrameEncoder,
    TaskSchedule,
)
from suites.nico.base import STATE_SIZE

# Middle and spread of joints (rad), grip and object positions (m) in demonstrations, so that the
# ground truth comes to the policy in the scale that latents have.
_STATE_LOC = (0.3, 0.9, 0.9, 0.45, 0.36, 0, 0.68, 0.4, 0.12, 0.655, 0.45, -0.05, 0.645)
_STATE_LOC += (0.41, -0.21, 0.645)
_STATE_SCALE = (0.35, 0.25, 0.35, 0.3, 0.06, 0.15, 0.05, *(0.03, 0.05, 0.02) * 3)


def observe(config: BGPOConfig, encoders: Representation | None, n_tasks: int) -> list[Transform]:
    """Returns the transforms from what the simulation shows to what the policy sees.

    Args:
        config: Says whether the policy sees latents or the ground truth, and a label or not.
        encoders: The trained encoders; needed for latents.
        n_tasks: Length of a label's one-hot vector.
    """
    transforms: list[Transform] = []
    if config.state == "latent":
        if encoders is None:
            raise ValueError("state='latent' needs trained encoders")
        transforms.append(FrameEncoder(encoders.vae, del_keys=True))
    else:
        loc, scale = torch.tensor(_STATE_LOC), torch.tensor(_STATE_SCALE)
        transforms.append(ObservationNorm(loc, scale, in_keys=["state"], standard_normal=True))
    # An object knocked off the table is dozens of deviations away and would swamp the rest.
    transforms.append(ClipTransform(in_keys=[config.state], low=-5.0, high=5.0))
    if config.context == "task_one_hot":
        transforms.append(
            UnaryTransform(["task"], ["task_one_hot"], fn=lambda t: one_hot(t, n_tasks).float())
        )
    return transforms


class BGPO:
    """BGPO, its ablations and its references with labels, for a batch of seeds.

    Args:
        config: Hyperparameters; ``state`` and ``context`` say what the policy sees.
        seeds: One for each element of the batch; they share nothing but the encoders.
        schedule: Which tasks are presented when.
        bank: Embedded demonstrations for training episodes.
        encoders: The trained encoders; None where neither latents nor embeddings are used. The
            frame encoder is moved to the device.
        device: Where frames are encoded, and actor and critic learn. Simulations, GWR-B and the
            replay stay on the CPU.

    Attributes:
        env: The composition of transforms.
        gwr: GWR-B, or None in the variants without it.
        actor: The policy, ``[S]`` stacked.
        critic: The Q-function, ``[S]`` stacked.
    """

    name = "bgpo"

    def __init__(
        self,
        config: BGPOConfig,
        *,
        seeds: Sequence[int],
        schedule: TaskSchedule,
        bank: DemonstrationBank,
        encoders: Representation | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config = config
        self.device = torch.device(device)
        if encoders is not None:
            encoders.vae.to(self.device)
        batch = torch.Size([len(seeds)])
        self.source = DemonstrationSource(
            bank, schedule, batch_size=batch, generator=generators(seeds, "demonstrations")
        )
        self.gwr: GWRB | None = None
        infer: list[Transform] = []
        reward: list[Transform] = []
        rewards = ["reward"]
        embedding_size = bank.embedding.shape[-1]
        # The distances that GWR-B needs are not those that a network learns well from.
        self._behavior_loc, self._behavior_scale = (
            bank.embedding.mean(0),
            bank.embedding.std(0).clamp_min(1e-6),
        )
        normalize = ObservationNorm(
            self._behavior_loc,
            self._behavior_scale,
            in_keys=["behavior"],
            out_keys=["normalized_behavior"],
            standard_normal=True,
        )
        if config.context == "behavior":
            self.gwr = GWRB(embedding_size, batch_size=batch, generator=generators(seeds, "gwr"))
            infer.append(BehaviorLookup(self.gwr, learn=True))
        elif config.context == "demo_embedding":
            infer.append(RenameTransform(["demo_embedding"], ["behavior"], create_copy=True))
        if config.context != "task_one_hot":
            if encoders is None:
                raise ValueError(f"context={config.context!r} needs trained encoders")
            reward = [normalize, BehaviorMatchingReward(encoders.lae, beta=config.beta)]
            rewards += ["extrinsic_reward", "intrinsic_reward"]
        transforms = [
            *observe(config, encoders, schedule.n_tasks),
            StepCounter(config.max_steps),
            self.source,
            *infer,
            *reward,
            RewardSum(in_keys=rewards, out_keys=[f"episode_{key}" for key in rewards]),
        ]
        self.simulation = NicoEnv(
            batch_size=batch,
            seed=[stream_seed(seed, "env") for seed in seeds],
            observation="pixels" if config.state == "latent" else "state",
        )
        self.env = TransformedEnv(self.simulation, Compose(transforms))
        labeled = config.context == "task_one_hot"
        context_key = "task_one_hot" if labeled else "normalized_behavior"
        context_size = schedule.n_tasks if labeled else embedding_size
        state_size = STATE_SIZE
        if config.state == "latent" and encoders is not None:
            state_size = encoders.vae.latent_size
        self.in_keys = (config.state, context_key)
        self._make_learner(seeds, state_size + context_size)

    def _make_learner(self, seeds: Sequence[int], in_features: int) -> None:
        ddpg, keys = self.config.ddpg, self.in_keys
        network = {
            "in_keys": keys,
            "hidden_sizes": ddpg.hidden_sizes,
            "batch_size": [len(seeds)],
        }
        self.actor = Actor(in_features, generator=generators(seeds, "actor"), **network)
        self.critic = Critic(
            in_features,
            layer_norm=ddpg.critic_layer_norm,
            generator=generators(seeds, "critic"),
            **network,
        )
        self.actor.to(self.device)
        self.critic.to(self.device)
        highest = 1.0 + (0.0 if keys[1] == "task_one_hot" else self.config.beta)
        self.loss = DDPGLoss(
            self.actor,
            self.critic,
            return_bounds=(0.0, highest) if ddpg.clip_targets else None,
            pre_tanh_penalty=ddpg.pre_tanh_penalty,
            constant_keys=[keys[1]],
        )
        self.loss.make_value_estimator(gamma=ddpg.gamma)
        self.target_update = ForeachSoftUpdate(self.loss, tau=ddpg.tau)
        self.optimizer = torch.optim.Adam(
            list(self.loss.parameters()), lr=ddpg.learning_rate, fused=True
        )
        self.replay = ReplayBuffer(
            ddpg.replay_size,
            batch_size=ddpg.batch_size,
            generator=generators(seeds, "replay"),
            keys=[
                *keys,
                "action",
                *(("next", key) for key in (keys[0], "reward", "terminated")),
            ],
        )
        self._noise = generators(seeds, "exploration")
        self._exploratory = torch.zeros(len(seeds), dtype=torch.bool)

    def _moved(self, batch: TensorDictBase) -> TensorDictBase:
        return batch if self.device == torch.device("cpu") else batch.to(self.device)

    @torch.no_grad()
    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the ``action`` ``[S, 4]`` of the policy with exploration noise.

        An exploratory episode consists of the noise alone. At each start of an episode it is drawn
        whether it is one, with a chance that falls as the critic expects more of the policy there.
        """
        chosen = self.actor(self._moved(tensordict.select(*self.in_keys)))
        starting = tensordict["step_count"].squeeze(-1) == 0
        if starting.any():
            self._draw_exploratory(starting, chosen)
        action = chosen["action"].cpu()
        action = torch.where(self._exploratory.unsqueeze(-1), 0.0, action)
        noise = [torch.randn(action.shape[-1:], generator=g) for g in self._noise]
        action = action + self.config.ddpg.noise * torch.stack(noise)
        return tensordict.set("action", action.clamp(-1.0, 1.0))

    def _draw_exploratory(self, starting: Tensor, chosen: TensorDictBase) -> None:
        ddpg = self.config.ddpg
        value = self.critic(chosen)["state_action_value"].squeeze(-1).cpu()
        chance = ddpg.exploratory_share * (1 - value / ddpg.promising_value).clamp(0.0, 1.0)
        for index in starting.nonzero().flatten().tolist():
            drawn = torch.rand((), generator=self._noise[index])
            self._exploratory[index] = drawn < chance[index]

    def store(self, transition: TensorDictBase) -> None:
        """Keeps a transition of each seed for updates to come."""
        self.replay.add(transition)

    def update(self) -> dict[str, Tensor]:
        """Makes one update of each seed from the transitions stored so far.

        Touches neither the environment nor what acting changes, so that it may run while the
        environment takes the step that has been chosen before.

        Returns:
            Losses, means over the seeds ``[]``; empty before the first update.
        """
        if len(self.replay) < self.config.ddpg.warmup_steps:
            return {}
        losses = self.loss(self._moved(self.replay.sample()))
        self.optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_value"]).backward()
        self.optimizer.step()
        self.target_update.step()
        n_seeds = self.source.episode.numel()
        return {key: losses[key].detach() / n_seeds for key in ("loss_actor", "loss_value")}

    @torch.no_grad()
    def infer(self, embedding: Tensor, task: Tensor) -> Tensor:
        """Returns what the policy is told for demonstrations, without learning from them.

        Args:
            embedding: phi of the demonstrations, ``[S, M, 32]``.
            task: Their labels, int64 ``[S, M]``; read only by the variants that need a label.

        Returns:
            The policy's second input, ``[S, M, context]``.
        """
        if self.in_keys[1] == "task_one_hot":
            return one_hot(task, self.source.schedule.n_tasks).float()
        behavior = embedding if self.gwr is None else self.gwr.lookup(embedding).embedding
        return (behavior - self._behavior_loc) / self._behavior_scale

    def state_dict(self) -> dict[str, Any]:
        """Returns all that the future of the run depends on but the tensordict in flight."""
        return {
            "loss": dict(self.loss.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "replay": self.replay.state_dict(),
            "source": dict(self.source.state_dict()),
            "gwr": None if self.gwr is None else dict(self.gwr.state_dict()),
            "simulation": self.simulation.simulation_state(),
            "noise": [generator.get_state() for generator in self._noise],
            "exploratory": self._exploratory.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from what `state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.replay.load_state_dict(state["replay"])
        self.source.load_state_dict(state["source"])
        if self.gwr is not None:
            self.gwr.load_state_dict(state["gwr"])
        self.simulation.load_simulation_state(state["simulation"])
        self._exploratory.copy_(state["exploratory"])
        for generator, saved in zip(self._noise, state["noise"], strict=True):
            generator.set_state(saved)
