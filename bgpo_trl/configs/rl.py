"""Defaults of the RL algorithms."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

from bgpo_trl.configs.checks import at_least, check, positive, whole


@dataclass(frozen=True)
class RLConfig:
    """Hyperparameters common to all RL algorithms f_RL of Alg. 1."""

    name: str = ""
    """Key in `bgpo_trl.algorithms.rl.RL`, which identifies the class in ``config.json``."""
    hidden_sizes: tuple[int, ...] = (256, 256)
    """Hidden layers of actor and critic. Ours: the 64 units of Sec. IV-A limit the success, and a
    second layer helps to read places from latents (docs/learning.md)."""
    critic_layer_norm: bool = True
    """Whether the critic's hidden layers have layer norm. Ours: halves the episodes needed."""
    learning_rate: float = 1e-3
    """Learning rate of Adam (Sec. IV-A)."""
    batch_size: int = 128
    """Transitions per update. Ours: 256 in Sec. IV-A; offsets half the cost of the larger
    networks."""
    replay_size: int = 1_000_000
    """Transitions kept for each seed (Sec. IV-A)."""
    gamma: float = 0.95
    """Discount factor. Ours: not given in the paper; an episode has about 20 steps."""
    tau: float = 0.005
    """Rate of the target networks' soft update. Ours: not given in the paper."""
    clip_targets: bool = True
    """Whether bootstrapped targets are clipped to the attainable returns. Ours: otherwise Q grows
    to hundreds."""
    imitation: float = 50.0
    """Weight of the squared distance to demonstrated actions in the actor's loss, of no effect
    without a ``demonstration_share``. Ours: with a tenth of it, the critic pulls the policy away
    from what was demonstrated (docs/learning.md)."""
    warmup_steps: int = 256
    """Environment steps of each seed before the first update. Ours: not given in the paper."""
    update_every: int = 1
    """Environment steps of each seed per update (1 in Alg. 1)."""

    def __post_init__(self) -> None:
        positive(self, "learning_rate")
        at_least(self, 0, "imitation")
        whole(self, 1, "batch_size", "warmup_steps", "replay_size", "update_every")
        # With a smaller replay, learning would never begin.
        least = max(self.batch_size, self.warmup_steps)
        sizes = bool(self.hidden_sizes) and all(
            isinstance(size, Integral) and size >= 1 for size in self.hidden_sizes
        )
        check(
            self,
            ("hidden_sizes", sizes, "one or more whole numbers, of at least 1"),
            ("gamma", 0 <= self.gamma <= 1, "between 0 and 1"),
            ("tau", 0 < self.tau <= 1, "above 0 and at most 1"),
            ("replay_size", self.replay_size >= least, f"{least} (batch, warm-up) or more"),
        )


@dataclass(frozen=True)
class DDPGConfig(RLConfig):
    """DDPG (Lillicrap et al., 2016), the paper's f_RL."""

    name: str = "ddpg"
    """See `RLConfig`."""
    noise: float = 0.3
    """Standard deviation of the Gaussian exploration noise. Ours: not given in the paper."""
    pre_tanh_penalty: float = 0.01
    """Weight of the squared pre-tanh actions. Ours: otherwise all actions saturate."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 0, "noise", "pre_tanh_penalty")


@dataclass(frozen=True)
class TD3Config(RLConfig):
    """TD3 (Fujimoto et al., 2018): two critics, delayed actor updates, target policy smoothing."""

    name: str = "td3"
    """See `RLConfig`."""
    noise: float = 0.3
    """Standard deviation of the Gaussian exploration noise. Ours: as in DDPG."""
    pre_tanh_penalty: float = 0.01
    """Weight of the squared pre-tanh actions. Ours: as in DDPG."""
    policy_delay: int = 2
    """Updates of the critics per update of actor and target networks (Fujimoto et al.)."""
    policy_noise: float = 0.2
    """Standard deviation of the noise on the target action (Fujimoto et al.)."""
    noise_clip: float = 0.5
    """Bound of the noise on the target action (Fujimoto et al.)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 0, "noise", "pre_tanh_penalty", "policy_noise", "noise_clip")
        whole(self, 1, "policy_delay")


@dataclass(frozen=True)
class SACConfig(RLConfig):
    """SAC (Haarnoja et al., 2018): two critics, a stochastic actor, a learned temperature."""

    name: str = "sac"
    """See `RLConfig`."""
    alpha_init: float = 0.1
    """Initial temperature. Ours: 1 would long outweigh a return of 1."""
    target_entropy: float = -1.0
    """Entropy maintained by the temperature, in nats for each component of an action (Haarnoja et
    al.)."""
    entropy_in_target: bool = False
    """Whether the critics' targets include the entropy. Ours: False as in Ball et al. (2023),
    unlike Haarnoja et al.; with entropy, values exceed the attainable returns."""

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, "alpha_init")
