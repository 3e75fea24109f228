"""Defaults of the RL algorithms, each with its source."""

from __future__ import annotations

from dataclasses import dataclass

from bgpo_trl.configs.checks import at_least, check, positive


@dataclass(frozen=True)
class RLConfig:
    """What all RL algorithms f_RL of Alg. 1 have in common."""

    name: str = ""
    """The algorithm, as `bgpo_trl.algorithms.rl.RL` has it; tells the classes apart in
    ``config.json``."""
    hidden_sizes: tuple[int, ...] = (256,)
    """Hidden layers of actor and critic. Ours: 64 units in Sec. IV-A, which limit what is learned
    (docs/learning.md)."""
    critic_layer_norm: bool = True
    """Normalize the critic's hidden layer. Ours: learns in half the episodes."""
    learning_rate: float = 1e-3
    """Rate of Adam (Sec. IV-A)."""
    batch_size: int = 128
    """Transitions an update. Ours: 256 in Sec. IV-A; pays for half of the larger networks."""
    replay_size: int = 1_000_000
    """Transitions kept for each seed (Sec. IV-A)."""
    gamma: float = 0.95
    """Discount. Ours: the paper does not say; an episode has about 20 steps."""
    tau: float = 0.005
    """Share of the weights that the target networks take over each update. Ours."""
    clip_targets: bool = True
    """Clip bootstrapped targets to the attainable returns [0, 1 + beta]. Ours: without it Q grows
    to hundreds."""
    warmup_steps: int = 256
    """Environment steps of each seed before the first update. Ours: one batch."""

    def __post_init__(self) -> None:
        positive(self, "learning_rate")
        at_least(self, 1, "batch_size", "warmup_steps")
        # With less, learning would never begin.
        least = max(self.batch_size, self.warmup_steps)
        check(
            self,
            ("hidden_sizes", min(self.hidden_sizes, default=0) >= 1, "one or more, of at least 1"),
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
    """Standard deviation of the Gaussian exploration noise on the action. Ours."""
    pre_tanh_penalty: float = 0.01
    """Weight of the squared pre-tanh actions. Ours: without it all actions saturate."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 0, "noise", "pre_tanh_penalty")


@dataclass(frozen=True)
class TD3Config(RLConfig):
    """TD3 (Fujimoto et al., 2018): two critics, a slower actor, noise on the target action."""

    name: str = "td3"
    """See `RLConfig`."""
    noise: float = 0.3
    """Standard deviation of the Gaussian exploration noise on the action. Ours: as in DDPG."""
    pre_tanh_penalty: float = 0.01
    """Weight of the squared pre-tanh actions. Ours: as in DDPG."""
    policy_delay: int = 2
    """Updates of the critics for each of the actor and the target networks (Fujimoto et al.)."""
    policy_noise: float = 0.2
    """Standard deviation of the noise on the target action (Fujimoto et al.)."""
    noise_clip: float = 0.5
    """Largest such noise (Fujimoto et al.)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 0, "noise", "pre_tanh_penalty", "policy_noise", "noise_clip")
        at_least(self, 1, "policy_delay")


@dataclass(frozen=True)
class SACConfig(RLConfig):
    """SAC (Haarnoja et al., 2018): two critics, a stochastic actor, a learned temperature."""

    name: str = "sac"
    """See `RLConfig`."""
    alpha_init: float = 0.1
    """First temperature. Ours: 1 would outweigh a return of 1 for long."""
    target_entropy: float = -4.0
    """Entropy that the temperature keeps, in nats: minus the number of actions, as in Haarnoja et
    al."""
    entropy_in_target: bool = False
    """Whether the critics count entropy to come. Ours: Haarnoja et al. do, but then values leave
    the range of returns that targets are clipped to; Ball et al. (2023) leave it out, too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, "alpha_init")
