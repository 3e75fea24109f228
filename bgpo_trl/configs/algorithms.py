"""Defaults of BGPO and the baselines."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from math import inf
from typing import Literal

from bgpo_trl.configs.settings import Settings


def check(config: object, *needs: tuple[str, bool, str]) -> None:
    """Raise ``ValueError`` for the first (field, condition, description) that does not hold."""
    for name, holds, need in needs:
        if not holds:
            raise ValueError(f"{name} must be {need}, got {getattr(config, name)}")


def at_least(config: object, least: int, *names: str) -> None:
    """Raise ``ValueError`` for a field that is smaller than ``least``, or not finite."""
    for name in names:
        check(config, (name, least <= getattr(config, name) < inf, f"at least {least}"))


def positive(config: object, *names: str) -> None:
    """Raise ``ValueError`` for a field that is not positive, or not finite."""
    for name in names:
        check(config, (name, 0 < getattr(config, name) < inf, "a number above 0"))


@dataclass(frozen=True)
class RLConfig(Settings):
    """Hyperparameters of the learner: the RL algorithm f_RL of Alg. 1, and the clone beside it.

    The defaults are DDPG (Lillicrap et al., 2016), the paper's f_RL: one critic, one-step returns,
    no clone. `SHOWN` has those of learning from demonstrations.
    """

    proposals: Literal["actor", "clone", "both"] = "actor"
    """Policies that propose an action: the actor that RL trains; a clone of the demonstrations
    shown, without reward; or both, of which critics take the better one (`ProposalPolicy`)."""
    critics: int = 1
    """Number of critics. With several, targets are the lower value of two of them."""
    n_steps: int = 1
    """Steps of the returns in the critics' targets (1 in the paper)."""
    imitation: float = 0.0
    """Weight of the squared distance to demonstrated actions in the actor's loss, at first. Ours:
    keeps the actor useful while critics know little (docs/learning.md)."""
    imitation_half_life: float | None = None
    """Updates of an actor in which the weight of imitation halves; None for never."""
    success_share: float = 0.0
    """Share of the imitated states and actions that are of own episodes which succeeded, once a
    group has some; the others are demonstrated. Ours."""
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
    noise: float = 0.3
    """Standard deviation of the Gaussian exploration noise. Ours: not given in the paper."""
    pre_tanh_penalty: float = 0.01
    """Weight of the squared pre-tanh actions. Ours: otherwise all actions saturate."""
    warmup_steps: int = 256
    """Environment steps of each seed before the first update. Ours: not given in the paper."""
    update_every: int = 1
    """Environment steps of each seed per update (1 in Alg. 1)."""
    policy_delay: int = 1
    """Updates of the critics, and of a clone, per update of the actor."""
    averaging: float = 0.0
    """Share that the latest weights have in the averages with which tests act; at first, 10 divided
    by the number of updates so far. With 0, tests act with the latest weights. Ours: these vary by
    several points from one test to the next."""
    caution: float = 1.0
    """With both proposals, standard deviations of the critics' gains by which their mean must be
    above 0 for the actor's proposal to be taken (`ProposalPolicy`)."""
    clone_episodes: int = 20
    """With both proposals, episodes of a group that its clone plays alone before the critics
    choose."""
    clone_share: float = 0.25
    """With both proposals, share of later training episodes that the clone plays alone, so that
    what it achieves is known; more while it is the better one (`ProposalTrials`)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, "learning_rate")
        if self.imitation_half_life is not None:
            positive(self, "imitation_half_life")
        at_least(self, 0, "noise", "pre_tanh_penalty", "imitation", "caution")
        at_least(self, 1, "batch_size", "warmup_steps", "replay_size", "update_every")
        at_least(self, 1, "critics", "n_steps", "policy_delay")
        at_least(self, 0, "clone_episodes")
        # With a smaller replay, learning would never begin.
        least = max(self.batch_size, self.warmup_steps)
        sizes = min(self.hidden_sizes, default=0) >= 1
        # By turns, of which the actor sees one in `policy_delay` (`DDPGLoss.pair`).
        pairs = [*combinations(range(self.critics), 2)] or [(0, 0)]
        turns = range(0, len(pairs) * self.policy_delay, self.policy_delay)
        seen = {critic for turn in turns for critic in pairs[turn % len(pairs)]}
        check(
            self,
            ("critics", self.critics > 1 or self.proposals != "both", "2 or more to choose"),
            (
                "critics",
                len(seen) == self.critics,
                f"a number of which the actor sees all, with a policy_delay of {self.policy_delay}",
            ),
            ("hidden_sizes", sizes, "one or more whole numbers, of at least 1"),
            ("gamma", 0 <= self.gamma <= 1, "between 0 and 1"),
            ("tau", 0 < self.tau <= 1, "above 0 and at most 1"),
            ("averaging", 0 <= self.averaging <= 1, "between 0 and 1"),
            ("replay_size", self.replay_size >= least, f"{least} (batch, warm-up) or more"),
            ("clone_share", 0 <= self.clone_share < 1, "at least 0 and below 1"),
            ("success_share", 0 <= self.success_share < 1, "at least 0 and below 1"),
            ("success_share", self.imitates or not self.success_share, "0 without imitation"),
        )

    @property
    def imitates(self) -> bool:
        """Whether a policy imitates demonstrated actions."""
        return self.proposals != "actor" or self.imitation > 0


SHOWN = RLConfig(
    proposals="both",
    critics=5,
    n_steps=3,
    imitation=0.2,
    imitation_half_life=5_000.0,
    hidden_sizes=(128, 128),
    learning_rate=3e-4,
    gamma=0.98,
    noise=0.1,
    update_every=2,
    policy_delay=2,
    averaging=3e-4,
    clone_share=0.1,
)
"""Learner from demonstrations and reward. Ours, from `docs/learning.md`."""


@dataclass(frozen=True)
class AlgorithmConfig(Settings):
    """Hyperparameters common to all algorithms, which are thus compared on equal terms."""

    state: Literal["latent", "state"] = "latent"
    """Observation of the policy: the latent z of a frame (Alg. 1) or the ground truth, to see
    what latents cost."""
    joints: bool = False
    """Whether policies and critics read the robot's joints beside the latent, in a scene that has
    them (`Scene.joints`). Ours."""
    max_steps: int = 50
    """Steps of an episode (Sec. IV-B)."""
    timeouts_bootstrap: bool = True
    """Whether a time-out is bootstrapped from, as it is no end of the task. Ours: in Alg. 1, it is
    terminal."""
    state_limit: float | None = 5.0
    """Bound of the observed state, in standard deviations; None for none, as in the paper. Ours."""
    rl: RLConfig = field(default_factory=RLConfig)
    """The RL algorithm f_RL; DDPG in the paper."""
    demonstration_share: float = 0.0
    """Share of an update's transitions taken from the demonstrations shown so far in training, with
    actions inferred by the inverse model. Ours: the paper has none."""
    demonstration_noise: float | None = None
    """Standard deviation of the noise added to the demonstrated states that a policy imitates; None
    for the one that was chosen when the bank was made (`choose_noise`). Ours: keeps policies from
    learning a few demonstrations by heart (docs/learning.md)."""
    demonstration_pace: float = 1.0
    """Factor of the demonstrated actions that a policy imitates. Ours: with 1.5, it learns the same
    movement in two thirds of the steps, where an action is a displacement or a speed, as NICO's;
    where it is a place, leave 1."""

    @property
    def observed(self) -> str:
        """Entry that policies read of the robot; latent and joints side by side are one entry."""
        return "latent_and_joints" if self.joints else self.state

    def __post_init__(self) -> None:
        super().__post_init__()
        share, rl = self.demonstration_share, self.rl
        beside = self.state == "latent" or not self.joints
        imitable = "above 0 for a policy to imitate (bgpo-experts: without)"
        unused = "left out where demonstration_share is 0: nothing is imitated"
        check(
            self,
            ("demonstration_share", 0 <= share < 1, "at least 0 and below 1"),
            ("joints", beside, "off with state='state', which tells more"),
            ("demonstration_share", share > 0 or not rl.imitates, imitable),
            ("demonstration_pace", share > 0 or self.demonstration_pace == 1, unused),
            ("demonstration_noise", share > 0 or self.demonstration_noise is None, unused),
        )
        at_least(self, 1, "max_steps")
        if self.state_limit is not None:
            positive(self, "state_limit")
        if self.demonstration_noise is not None:
            at_least(self, 0, "demonstration_noise")
        positive(self, "demonstration_pace")
        if share and rl.warmup_steps < self.max_steps:
            # Else, seeds would learn from demonstrations sooner or later than each would alone.
            raise ValueError(
                f"with a demonstration_share, warmup_steps ({rl.warmup_steps}) must be at "
                f"least max_steps ({self.max_steps}), so that each seed has ended one episode"
            )


def _check_played(config: AlgorithmConfig, rows: int) -> None:
    """Raise ``ValueError`` if demonstrations leave none of an update's transitions to training."""
    leaves = round(config.demonstration_share * rows) < rows
    check(config, ("demonstration_share", leaves, f"less, to leave some of {rows} transitions"))


def _check_literal(config: AlgorithmConfig, name: str, given: bool) -> None:
    """Raise ``ValueError`` where what the paper has meets demonstrations, which it has not."""
    check(config, (name, not (given and config.demonstration_share), "off with demonstrations"))


@dataclass(frozen=True)
class GWRBConfig(Settings):
    """Constants of GWR-B, by default those of Table 1; see `GWRB` for the learning rule."""

    activity_threshold: float = 0.8
    """Activity a_T in [0, 1] below which a node is inserted (Table 1)."""
    habituation_threshold: float = 0.15
    """Habituation h_T below which a best-matching node allows an insertion (Table 1)."""
    activity_scale: float = 1.0
    """Factor s of distances in the activity (Eq. 2 has none). Inputs and random weights multiplied
    by s have the same effect."""
    lr_best: float = 0.1
    """Learning rate eps_c of the best-matching node, at most 1 (Table 1)."""
    lr_neighbor: float = 0.01
    """Learning rate eps_n of its neighbors, at most eps_c (Table 1)."""
    initial_habituation: float = 1.0
    """Habituation h_0 of a new node, in (0, 1] (Table 1)."""
    alpha_best: float = 1.05
    """Constant alpha of the habituation of the best-matching node (Table 1); at least 1 / h_0, so
    that h stays positive."""
    alpha_neighbor: float = 1.05
    """Constant alpha of the habituation of its neighbors (Table 1); at least 1 / h_0."""
    tau_best: float = 3.3
    """Time constant tau of the habituation of the best-matching node (Table 1); the larger, the
    slower it habituates."""
    tau_neighbor: float = 14.3
    """Time constant tau of the habituation of its neighbors (Table 1)."""
    max_age: int = 80
    """Age kappa beyond which an edge is removed (Table 1)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(self, "activity_scale", "tau_best", "tau_neighbor")
        at_least(self, 0, "habituation_threshold", "lr_neighbor")
        at_least(self, 1, "max_age")
        ordered = self.lr_neighbor <= self.lr_best <= 1
        check(
            self,
            ("activity_threshold", 0 <= self.activity_threshold <= 1, "between 0 and 1"),
            ("lr_best", ordered, f"at least lr_neighbor ({self.lr_neighbor}), at most 1"),
            ("initial_habituation", 0 < self.initial_habituation <= 1, "above 0, at most 1"),
        )
        least = 1 / self.initial_habituation
        best, neighbor = (least <= x < inf for x in (self.alpha_best, self.alpha_neighbor))
        check(
            self,
            ("alpha_best", best, "at least 1 / initial_habituation"),
            ("alpha_neighbor", neighbor, "at least 1 / initial_habituation"),
        )


@dataclass(frozen=True)
class BGPOConfig(AlgorithmConfig):
    """Behavior-guided policy optimization (Alg. 1)."""

    context: Literal["behavior", "embedding", "label"] | None = "behavior"
    """Information about the task that policies read besides the state: the behavior b of GWR-B
    (Alg. 1); the demonstration's embedding phi in its place, without GWR-B (Fig. 9); the label of
    the task, or nothing, for references."""
    beta: float = 0.1
    """Weight of the intrinsic reward (Sec. IV-A)."""
    behavior_scale: float = 0.25
    """Factor of b in the context. Ours: 1 in the paper slows down the first task
    (docs/learning.md)."""
    gwr: GWRBConfig = field(default_factory=lambda: GWRBConfig(activity_scale=0.25))
    """The network whose nodes are behaviors. Ours: with an activity_scale of 1, as in the paper,
    every third demonstration becomes a node; with 0.25 there are about 200 nodes after 1,800
    demonstrations."""
    experts: bool = True
    """Whether each group of behaviors has its own actor and critic. Ours: with the paper's single
    pair, a new task is learned slowly (docs/learning.md)."""
    group_balanced_replay: bool = True
    """Whether an update draws equally from the groups played last. Ours: the paper draws uniformly
    from all transitions."""
    demonstration_share: float = 0.5
    """See `AlgorithmConfig`. Ours: what demonstrations show is rarely found by chance."""
    rl: RLConfig = SHOWN
    """See `AlgorithmConfig`."""
    active_groups: int = 1
    """Largest number of groups per update, those played last. Ours: bounds the cost of an
    update."""
    rest_after: int = 500
    """Training steps without being played after which one of several active groups rests: it has no
    part in updates and its expert does not change until it is played again. Ours: from old
    transitions alone, an expert gets worse (docs/learning.md)."""
    expert_batch_size: int = 128
    """Transitions of each active group per update, with experts. Ours: as many as MAML and Dist-NLL
    with demonstrations have per task; without experts, the RL algorithm's ``batch_size`` is shared
    by all groups."""
    group_size: int = 10
    """Least number of different demonstrations of a group among few; see `least_size`. Ours."""
    group_evidence: float = 1.0
    """Depth of the valley of density between two groups, in multiples of what chance explains
    (`density_clusters`). Ours."""

    @property
    def grouped(self) -> bool:
        """Whether behaviors are grouped."""
        return self.experts or self.group_balanced_replay

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 0, "beta")
        at_least(self, 1, "active_groups", "rest_after", "expert_batch_size")
        seen = self.state == "latent" or self.context not in ("behavior", "embedding")
        check(self, ("beta", seen or not self.beta, "0 with the ground truth: it compares latents"))
        positive(self, "behavior_scale", "group_evidence")
        at_least(self, 4, "group_size")
        holds = self.group_balanced_replay or not self.experts
        check(self, ("group_balanced_replay", holds, "set where there are experts"))
        _check_played(self, self.expert_batch_size if self.experts else self.rl.batch_size)


@dataclass(frozen=True)
class FineTuningConfig(BGPOConfig):
    """Fine-tuning: one policy, by default without context."""

    context: Literal["behavior", "embedding", "label"] | None = None
    """See `BGPOConfig`."""
    experts: bool = False
    """See `BGPOConfig`; only False."""
    group_balanced_replay: bool = False
    """See `BGPOConfig`; only False."""
    demonstration_share: float = 0.0
    """See `AlgorithmConfig`; of the demonstrations shown since the latest boundary."""
    rl: RLConfig = field(default_factory=RLConfig)
    """See `AlgorithmConfig`."""

    def __post_init__(self) -> None:
        # First, since experts need a replay that is balanced.
        for name in ("experts", "group_balanced_replay"):
            check(self, (name, not getattr(self, name), "off, as in fine-tuning"))
        super().__post_init__()


@dataclass(frozen=True)
class EWCConfig(FineTuningConfig):
    """Elastic weight consolidation (Kirkpatrick et al., 2017)."""

    ewc_weight: float = 1e4
    """Weight lambda of the penalty. Ours: as in an example of Continual World, and not tuned."""
    fisher_samples: int = 2_560
    """Transitions from which the Fisher information of a task is estimated (Continual World)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 0, "ewc_weight")
        at_least(self, 1, "fisher_samples")


@dataclass(frozen=True)
class TaskConfig(AlgorithmConfig):
    """Hyperparameters of the algorithms that know the task label."""

    task_batch_size: int = 64
    """Transitions of each task per update. Ours: with three tasks, as many as in an update of BGPO.
    MAML adapts to one half and evaluates the adapted policy on the other."""
    share_batch: bool = False
    """Whether the tasks share ``task_batch_size`` transitions in equal parts."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "task_batch_size")
        _check_played(self, self.task_batch_size)
        _check_literal(self, "share_batch", self.share_batch)


@dataclass(frozen=True)
class MAMLConfig(TaskConfig):
    """Model-agnostic meta-learning over DDPG (Sec. IV-B; Finn et al., 2017)."""

    inner_learning_rate: float = 1.0
    """Step size of the gradient step that adapts the policy to a task. Ours: large enough to change
    the policy's actions."""
    adaptation_size: int = 256
    """Transitions of the test task to adapt to before its test episodes. Ours: Sec. IV-B has "256
    adaptation trajectories", about 50 times as much."""
    adapt_to_latest: bool = False
    """Whether these are the latest transitions of the task, instead of being drawn from all."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 0, "inner_learning_rate")
        at_least(self, 1, "adaptation_size")
        alone = self.rl.proposals == "actor"
        check(self, ("rl", alone, "of an actor without clone, since MAML adapts one policy"))
        check(self, ("task_batch_size", self.task_batch_size % 2 == 0, "even"))
        _check_literal(self, "adapt_to_latest", self.adapt_to_latest)


@dataclass(frozen=True)
class DistNLLConfig(TaskConfig):
    """Policy distillation with a negative log-likelihood (Sec. IV-B; Rusu et al., 2016)."""

    samples: int = 1_000
    """States of each task from which its head learns at the end of an episode (Sec. IV-B)."""
    distillation_batch_size: int = 125
    """States of each task per gradient step, hence eight steps per episode; the last step has what
    is left. Ours: 256 in the paper."""
    learning_rate: float = 1e-3
    """Learning rate of Adam for the multi-task policy. Ours: the teachers'."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "samples", "distillation_batch_size")
        positive(self, "learning_rate")
