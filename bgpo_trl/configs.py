"""Every default in one place, each with its source: the paper's section, or "ours" and why."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Literal

from suites import nico


def _check(config: object, *needs: tuple[str, bool, str]) -> None:
    """Raises ValueError for the first need (field, whether it holds, in words) that does not."""
    for name, holds, need in needs:
        if not holds:
            raise ValueError(f"{name} must be {need}, got {getattr(config, name)}")


def _at_least(config: object, least: int, *names: str) -> None:
    """Raises ValueError for a number that is smaller, or not finite."""
    for name in names:
        _check(config, (name, least <= getattr(config, name) < inf, f"at least {least}"))


def _positive(config: object, *names: str) -> None:
    """Raises ValueError for a number that is not positive, or not finite."""
    for name in names:
        _check(config, (name, 0 < getattr(config, name) < inf, "a number above 0"))


@dataclass(frozen=True)
class VAEConfig:
    """Training of the VAE and its inverse model (stage 1a)."""

    latent_size: int = 64
    """Dimensions of z (Sec. IV-A)."""
    batch_size: int = 128
    """Frames a step, drawn as ``batch_size / window`` windows. Ours: 256 in Sec. IV-A, but on two
    cores the time is better spent on more steps."""
    window: int = 2
    """Consecutive frames a window. Ours: the inverse model needs pairs, and a window encodes each
    frame once for both pairs it belongs to."""
    learning_rate: float = 2e-3
    """Peak rate of Adam. Ours: 1e-4 in Sec. IV-A, too slow for so few steps."""
    warmup_steps: int = 100
    """Steps of linear warm-up; cosine decay to zero follows. Ours."""
    steps: int = 2_500
    """Gradient steps. Ours: the paper does not say."""
    reconstruction_weight: float = 1.0
    """Factor of the squared error summed over a frame. Ours."""
    kl_weight: float = 0.01
    """Factor of the KL divergence summed over dimensions."""
    inverse_weight: float = 50.0
    """Factor of the inverse model's ``1/2 ||a_hat - a||^2``."""

    def __post_init__(self) -> None:
        _at_least(self, 1, "latent_size", "batch_size", "warmup_steps", "steps")
        _positive(self, "learning_rate")
        _at_least(self, 0, "reconstruction_weight", "kl_weight", "inverse_weight")
        divides = self.window >= 2 and self.batch_size % self.window == 0
        _check(self, ("window", divides, f"at least 2 and divide batch_size {self.batch_size}"))


@dataclass(frozen=True)
class SequenceAutoencoderConfig:
    """Training of the LSTM autoencoder on latent sequences (stage 1b)."""

    embedding_size: int = 32
    """LSTM units of encoder and decoder, so dimensions of phi (Sec. IV-A)."""
    batch_size: int = 256
    """Sequences a step (Sec. IV-A)."""
    learning_rate: float = 1e-3
    """Peak rate of Adam (Sec. IV-A)."""
    warmup_steps: int = 100
    """Steps of linear warm-up; cosine decay to zero follows. Ours."""
    steps: int = 5_000
    """Gradient steps. Ours: the paper does not say."""

    def __post_init__(self) -> None:
        _at_least(self, 1, "embedding_size", "batch_size", "warmup_steps", "steps")
        _positive(self, "learning_rate")


@dataclass(frozen=True)
class RepresentationConfig:
    """Stage 1: both encoders."""

    vae: VAEConfig = field(default_factory=VAEConfig)
    """The frame encoder."""
    lae: SequenceAutoencoderConfig = field(default_factory=SequenceAutoencoderConfig)
    """The sequence encoder."""
    seed: int = 0
    """Seed of initial weights, batches and sampling noise. Ours."""
    checkpoint_every: int = 250
    """Steps between checkpoints (about a minute each). Ours."""
    log_every: int = 20
    """Steps between rows of the log. Ours."""

    def __post_init__(self) -> None:
        _at_least(self, 0, "seed")
        _at_least(self, 1, "checkpoint_every", "log_every")


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
        _positive(self, "learning_rate")
        _at_least(self, 1, "batch_size", "warmup_steps")
        # With less, learning would never begin.
        least = max(self.batch_size, self.warmup_steps)
        _check(
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
        _at_least(self, 0, "noise", "pre_tanh_penalty")


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
        _at_least(self, 0, "noise", "pre_tanh_penalty", "policy_noise", "noise_clip")
        _at_least(self, 1, "policy_delay")


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
        _positive(self, "alpha_init")


@dataclass(frozen=True)
class AlgorithmConfig:
    """What all algorithms have in common, so that they are compared on equal terms."""

    state: Literal["latent", "state"] = "latent"
    """What the policy sees of the world: z of a frame, or (for the ladder) the ground truth."""
    max_steps: int = 50
    """Steps of an episode (Sec. IV-B)."""
    rl: RLConfig = field(default_factory=DDPGConfig)
    """The RL algorithm f_RL."""
    demonstration_share: float = 0.0
    """Share of an update's transitions that are taken from the demonstrations shown in training
    episodes so far, with actions that the inverse model inferred. The paper has none."""

    def __post_init__(self) -> None:
        known = self.state in ("latent", "state")
        share = self.demonstration_share
        _check(
            self,
            ("state", known, "latent or state"),
            ("demonstration_share", 0 <= share < 1, "at least 0 and below 1"),
        )
        _at_least(self, 1, "max_steps")
        if share and self.rl.warmup_steps < self.max_steps:
            # Else seeds would learn from demonstrations sooner or later than each would alone.
            raise ValueError(
                f"with a demonstration_share, warmup_steps ({self.rl.warmup_steps}) must be at "
                f"least max_steps ({self.max_steps}), so that every seed was shown one by then"
            )


def _refuse_all_but_ddpg(who: str, rl: RLConfig) -> None:
    if not isinstance(rl, DDPGConfig):
        raise ValueError(
            f"{who} is defined over DDPG, not {rl.name!r}: leave its rl as it is; BGPO, its "
            "ablations and the references take any"
        )


@dataclass(frozen=True)
class GWRBConfig:
    """Growth of GWR-B; its other settings are those of Table 1 (`GWRB`)."""

    activity_threshold: float = 0.8
    """Activity below which a node is inserted (Table 1)."""
    habituation_threshold: float = 0.15
    """Habituation below which a node may have another inserted beside it (Table 1)."""
    activity_scale: float = 0.25
    """Factor of distances in the activity. Ours: with 1, as in the paper, each demonstration is so
    far from the next that a node is made of every third; with 0.25 there are about 300 after 6,000
    episodes."""

    def __post_init__(self) -> None:
        _positive(self, "activity_scale")
        _check(
            self,
            ("activity_threshold", 0 < self.activity_threshold < 1, "between 0 and 1"),
            ("habituation_threshold", 0 < self.habituation_threshold <= 1, "above 0, at most 1"),
        )


@dataclass(frozen=True)
class BGPOConfig(AlgorithmConfig):
    """Behavior-guided policy optimization (Alg. 1)."""

    beta: float = 0.1
    """Weight of the intrinsic reward (Sec. IV-A)."""
    behavior_scale: float = 0.25
    """Factor of b where actor and critic read it. Ours: 1 in the paper, which slows down the first
    task (docs/learning.md)."""
    gwr: GWRBConfig = field(default_factory=GWRBConfig)
    """The network whose nodes are behaviors."""
    experts: bool = True
    """An actor and a critic for each group of behaviors. Ours: one of each for all in the paper,
    which learns a new task slowly (docs/learning.md)."""
    even_replay: bool = True
    """Draw an update's transitions in equal parts from the groups played last. Ours: from all alike
    in the paper."""
    demonstration_share: float = 0.25
    """See `AlgorithmConfig`. Ours: triples the success of a task's first hundred episodes."""
    active_groups: int = 3
    """Groups that an update learns from at most, those played last. Ours."""
    expert_batch_size: int = 64
    """Transitions of each active group in an update of experts, as many as MAML and Dist-NLL have
    of each task. Ours; without experts it is the RL algorithm's ``batch_size`` for all together."""
    groups: GWRBConfig = field(
        default_factory=lambda: GWRBConfig(activity_threshold=0.525, habituation_threshold=0.5)
    )
    """The coarse network that finds the groups. Ours: so it finds one group, seldom two, for each
    of NICO's tasks (docs/learning.md)."""

    @property
    def grouped(self) -> bool:
        """Whether groups of behaviors are told apart."""
        return self.experts or self.even_replay

    def __post_init__(self) -> None:
        super().__post_init__()
        _at_least(self, 0, "beta")
        _at_least(self, 1, "active_groups", "expert_batch_size")
        _positive(self, "behavior_scale")
        holds = self.even_replay or not self.experts
        _check(self, ("even_replay", holds, "set where there are experts"))


@dataclass(frozen=True)
class MAMLConfig(AlgorithmConfig):
    """Model-agnostic meta-learning over DDPG (Sec. IV-B; Finn et al., 2017)."""

    inner_learning_rate: float = 1.0
    """Length of the one gradient step by which the policy adapts to a task. Ours: long enough to
    change what the policy does."""
    task_batch_size: int = 64
    """Transitions of each task in an update: half of them to adapt to, half to judge the adapted
    policy by. Ours: three tasks together see more than the 128 of the other algorithms."""
    adaptation_size: int = 256
    """Transitions of the test task that the policy adapts to before its test episodes. Sec. IV-B
    has "256 adaptation trajectories", about 50 times as much."""

    rl: DDPGConfig = field(default_factory=DDPGConfig)
    """Its own steps are DDPG's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_all_but_ddpg("MAML", self.rl)
        _at_least(self, 0, "inner_learning_rate")
        _at_least(self, 1, "adaptation_size")
        halves = self.task_batch_size >= 2 and self.task_batch_size % 2 == 0
        _check(self, ("task_batch_size", halves, "even and at least 2"))


@dataclass(frozen=True)
class DistNLLConfig(AlgorithmConfig):
    """Policy distillation with a negative log-likelihood (Sec. IV-B; Rusu et al., 2016)."""

    task_batch_size: int = 64
    """Transitions of each task in an update of its teacher. Ours: three teachers together see more
    than the 128 of the other algorithms."""
    samples: int = 1_000
    """States of each task that its head learns from at the end of an episode (Sec. IV-B)."""
    distillation_batch_size: int = 125
    """States of each task a gradient step, so eight steps an episode. Ours: the paper does not
    say."""
    learning_rate: float = 1e-3
    """Rate of Adam for the multi-task policy. Ours: the teachers' own."""

    rl: DDPGConfig = field(default_factory=DDPGConfig)
    """Its teachers are DDPG's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_all_but_ddpg("Dist-NLL", self.rl)
        _at_least(self, 1, "task_batch_size", "samples")
        _positive(self, "learning_rate")
        if self.distillation_batch_size < 1 or self.samples % self.distillation_batch_size:
            raise ValueError(
                f"samples ({self.samples}) must be a multiple of distillation_batch_size "
                f"({self.distillation_batch_size})"
            )


@dataclass(frozen=True)
class RunConfig:
    """One run of an experiment: which seeds, how long, which tasks when."""

    seeds: tuple[int, ...] = tuple(range(10))
    """Seeds, run as one batch (Sec. IV: 10)."""
    episodes: int = 20_000
    """Training episodes of each seed (Figs. 6 and 8)."""
    tasks: tuple[str, ...] = nico.ALL_TASKS
    """The tasks, by the names that the suite and the CSV files give them."""
    task_starts: tuple[int, ...] = (0, 7_000, 13_000)
    """Episode from which each task is presented (Sec. IV-C); all 0 is the concurrent setting."""
    eval_every: int = 1
    """Training episodes between evaluations (1 in the paper)."""
    eval_episodes: int = 1
    """Test episodes of each task presented so far, each evaluation. The paper has one episode of
    one random task; testing every task costs more and says more."""
    held_out: Literal["validation", "test"] = "validation"
    """Which half of the held-out demonstrations test episodes show: the one by which settings are
    chosen, or the one on which results are reported. Ours."""
    checkpoint_minutes: float = 10.0
    """Minutes between checkpoints. Ours."""
    name: str = "bgpo"
    """The algorithm, or the variant of it, as the CSV files call it."""
    algorithm: AlgorithmConfig = field(default_factory=BGPOConfig)
    """The algorithm's hyperparameters."""

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(f"a run needs seeds, all different and none negative: {self.seeds}")
        _at_least(self, 1, "episodes", "eval_every", "eval_episodes")
        _at_least(self, 0, "checkpoint_minutes")
        _check(self, ("held_out", self.held_out in ("validation", "test"), "validation or test"))
        nico.check_tasks(self.tasks)
        starts = self.task_starts
        _check(
            self,
            ("task_starts", len(starts) == len(self.tasks), "one episode for each of the tasks"),
            ("task_starts", min(starts, default=-1) == 0, "at least 0, and one of them 0"),
        )


PRESETS: dict[str, RunConfig] = {
    "smoke": RunConfig(
        seeds=(0, 1), episodes=12, task_starts=(0, 4, 8), eval_every=6, eval_episodes=1
    ),
    "quick": RunConfig(
        seeds=(0, 1, 2), episodes=1_200, task_starts=(0, 420, 780), eval_every=60, eval_episodes=4
    ),
    "desk": RunConfig(
        seeds=(0, 1, 2, 3, 4),
        episodes=6_000,
        task_starts=(0, 2_100, 3_900),
        eval_every=100,
        eval_episodes=5,
    ),
    "paper": RunConfig(),
}
"""What ``--preset`` names: every stage in minutes; learning to look at; five seeds overnight at
most; the paper's scale."""


@dataclass(frozen=True)
class StageConfig:
    """Stage 1 of a preset that makes its own encoders."""

    per_task: int
    """Demonstrations of each task."""
    held_out_per_task: int
    """How many of those are held out."""
    config: RepresentationConfig
    """Training of the encoders."""


STAGE_PRESETS: dict[str, StageConfig] = {
    "smoke": StageConfig(
        per_task=12,
        held_out_per_task=4,
        config=RepresentationConfig(
            vae=VAEConfig(steps=20, batch_size=64),
            lae=SequenceAutoencoderConfig(steps=50, batch_size=32),
        ),
    )
}
"""Presets that go through every stage from nothing instead of using the shipped encoders."""
