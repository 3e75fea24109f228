"""Arguments of the commands, whose docstrings are the help.

Nothing here imports TorchRL or MuJoCo, so that ``--help`` is quick.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from bgpo_trl.configs import BGPOConfig, RepresentationConfig, RunConfig

SETTINGS: Any = tyro.conf.SuppressFixed[RunConfig]
"""The settings of a run, for their flags."""


@dataclass(frozen=True, kw_only=True)
class ImportArguments:
    """Own tasks, algorithms and frame encoders in a command."""

    module: Annotated[str | None, tyro.conf.arg(name="import")] = None
    """Module that adds scenes (SCENES), tasks (nico.add_task), algorithms (ALGORITHMS) or frame
    encoders (FRAME_NETWORKS), imported first; here or installed."""


@dataclass(frozen=True, kw_only=True)
class BankArguments(ImportArguments):
    """Tasks and their demonstrations."""

    scene: str | None = None
    """Robot with its tasks, nico by default, or one that the module of --import adds."""
    tasks: tuple[str, ...] | None = None
    """Tasks in the order of presentation, or "all" for all of the scene; by default its usual ones,
    for NICO the paper's three. Three tasks start as in the paper, others at even intervals."""
    encoders: Path | None = None
    """Encoders trained by `bgpo encoders`, with their bank beside them; those that come
    with the scene by default. With --resume, the run's own."""
    bank: Path | None = None
    """Demonstrations embedded by `bgpo bank`; for tasks missing in it, those beside
    the encoders are used. With --resume, the run's own by default."""


@dataclass(frozen=True)
class Arguments(BankArguments):
    """Train an algorithm to the end, test it and draw the figures.

    Writes a run directory: config.json, train.csv, eval.csv, final.csv, cost.csv,
    summary.json, checkpoint/ and figures/, among them success.png (success on each task against
    training episodes), gwr.png (nodes of GWR-B in behavior space, Fig. 7) and groups.png.

    A flag overrides the file of --config, and the file overrides --preset. All settings of
    config.json are flags, such as --seeds 0 1, --algorithm.beta 0.2 or --algorithm.rl.noise 0.1;
    --help lists these flags last.
    """

    algorithm: str | None = None
    """bgpo, the default; clone: without reward; bgpo-experts: without demonstrations as experience;
    bgpo-single: without experts too; maml and dist-nll: the baselines; bgpo-paper, maml-paper,
    dist-nll-paper: as published; oracle and ddpg: DDPG with the task label as context, and without
    context; fine-tuning and ewc: DDPG without context that is given task boundaries, best with
    --schedule sequential; maml, dist-nll, oracle, fine-tuning or ewc followed by -demonstrations:
    with demonstrations as experience. Ablations (Fig. 9): without-bonus, without-gwr, without-both:
    bgpo-single without the intrinsic reward, GWR-B or both; group-balanced-replay, demonstrations:
    bgpo-single with that addition. Or one that the module of --import adds."""
    preset: Literal["smoke", "quick", "desk", "paper"] | None = None
    """Size of the run, with its time on two cores: smoke (12 episodes of 2 seeds, every stage in 2
    minutes), quick (1,800 episodes of 2 seeds, half an hour), the default; desk (6,000 episodes of
    5 seeds, three hours) or paper (20,000 episodes of 10 seeds, days)."""
    config: Path | None = None
    """YAML or JSON file of settings, named as in a run's config.json, or a run directory to repeat;
    the preset's for those that it lacks."""
    out: Path | None = None
    """Run directory; runs/EXPERIMENT-ALGORITHM-PRESET by default, with the name of the file
    of --config for PRESET."""
    episodes: int | None = None
    """Training episodes; the preset's by default. The task starts are scaled in proportion. With
    --resume, a larger number extends the run, whose task starts are kept."""
    resume: bool = False
    """Continue the run in the directory, or begin it if there is none. With --out, or in a run's
    folder, and with neither --preset nor --config, its settings are those of the run."""
    add_task: str | None = None
    """With --resume, a further task for the run, which learns it from the next episode that no seed
    has begun, and keeps what it has learned. Demonstrations are taken from --bank, embedded by the
    run's encoders (`bgpo bank`), or from beside these. A finished run needs more --episodes."""
    logged: Path | None = None
    """Logged episodes of write_logged_episodes, of tasks presented from the start, for the replay
    before the first episode; with --offline-updates, also to learn from by then. --resume needs
    them no more."""
    train_encoders: bool = False
    """Record demonstrations and train new encoders instead of using the pretrained ones."""
    encoder_settings: Path | None = None
    """With --train-encoders, a YAML or JSON file of the settings that `bgpo encoders --help` lists,
    such as `vae: {steps: 2000}`; the usual ones for those that it lacks."""
    wandb: Literal["online", "offline"] | None = None
    """Also log means over the seeds to Weights & Biases, in the group EXPERIMENT-ALGORITHM."""
    tensorboard: bool = False
    """Also log these means to TensorBoard, into the run directory."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, or auto for a GPU if there is one."""
    threads: int = 1
    """Threads of PyTorch; more than one slows these small networks down. Physics always uses all
    cores."""
    settings: tyro.conf.Suppress[tuple[str, ...]] = ()
    """Flags of single settings of `RunConfig`, which `run_config` reads."""

    def gives(self, setting: str) -> bool:
        """Return whether a setting of `RunConfig` is among the flags."""
        names = (flag.partition("=")[0].replace("-", "_") for flag in self.settings)
        return f"__{setting}" in names


@dataclass(frozen=True)
class RecordArguments(ImportArguments):
    """Record demonstrations, or random play.

    The same command resumes an interrupted recording.
    """

    same_command_continues: ClassVar[bool] = True
    path: tyro.conf.Positional[Path]
    """Folder of the dataset."""
    scene: str = "nico"
    """Robot, nico or one that the module of --import adds."""
    tasks: tuple[str, ...] | None = None
    """Tasks to demonstrate, or "all" for all of the scene; by default its usual ones, for NICO the
    paper's three."""
    per_task: int = 1_200
    """Demonstrations of each task."""
    held_out_per_task: int = 200
    """How many of those are held out for test episodes."""
    play: bool = False
    """Record random play instead of demonstrations."""
    spread: float = 1.0
    """Share of the whole range of start states."""
    seed: int = 0
    """Seed of the start states and of the noise."""


@dataclass(frozen=True)
class EncodersArguments(ImportArguments):
    """Train both encoders on recorded demonstrations and play, then probe them.

    With --config.frame-network NAME, the frame encoder is your own and stays as it is.

    The same command resumes an interrupted training.
    """

    same_command_continues: ClassVar[bool] = True
    dataset: tyro.conf.Positional[Path]
    """Folder of the recorded demonstrations."""
    play: tyro.conf.Positional[Path | None] = None
    """Folder of recorded play; without it, the frame encoder learns from demonstrations only."""
    weights: Path | None = None
    """File to write, with the bank beside it; by default encoders.safetensors in the folder."""
    keep: Path | None = None
    """Encoders to keep: only their inverse model is trained anew, on play."""
    folder: Path = Path("runs/encoders")
    """Folder for checkpoints, log and probes."""
    settings: Path | None = None
    """YAML or JSON file of hyperparameters, such as `vae: {steps: 2000}`; flags change them."""
    config: RepresentationConfig = field(default_factory=RepresentationConfig)
    """Hyperparameters."""
    device: str = "auto"
    """Device to train on: cpu, cuda, or auto for a GPU if there is one."""


@dataclass(frozen=True)
class MakeBankArguments(ImportArguments):
    """Embed recorded demonstrations with trained encoders, for --bank of a run."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the recorded demonstrations."""
    out: tyro.conf.Positional[Path]
    """Bank to write."""
    encoders: Path | None = None
    """Encoder weights; by default those that come with the scene."""
    actions: Literal["inferred", "recorded"] | None = None
    """Actions of the stored demonstrations, inferred from frames or recorded; by default as the
    scene says."""


@dataclass(frozen=True)
class ProbesArguments(ImportArguments):
    """Evaluate trained encoders: what can be read from latents, embeddings and inferred actions.

    Writes probes.json and reconstructions.png.
    """

    dataset: tyro.conf.Positional[Path]
    """Folder of the recorded demonstrations."""
    play: tyro.conf.Positional[Path | None] = None
    """Folder of recorded play."""
    encoders: Path | None = None
    """Encoder weights; by default those of the scene for the dataset's tasks."""
    out: Path = Path("runs/probes")
    """Folder to write to."""


Setting = Literal[
    "concurrent",
    "continual",
    "sequential",
    "ablation",
    "eight",
    "eight-reversed",
    "eight-sequential",
    "eight-concurrent",
]
"""How tasks are presented in a sweep."""


@dataclass(frozen=True)
class SweepArguments(BankArguments):
    """Run algorithms in settings over many seeds on Ray, in blocks of seeds.

    The same command resumes an interrupted sweep without repeating finished jobs, and seeds may be
    added. A job whose worker or machine is lost continues elsewhere from its last checkpoint. On a
    cluster, all machines need Ray and bgpo_trl, and must see --out at the same path.
    """

    same_command_continues: ClassVar[bool] = True
    algorithms: tuple[str, ...] = ("bgpo",)
    """Algorithms, as in `bgpo concurrent`."""
    settings: tuple[Setting, ...] = ("concurrent",)
    """Tasks all from the start (concurrent); one after another, with earlier ones practised
    (continual) or not (sequential); or the variants of BGPO instead of the algorithms (ablation).
    Or the suite's eight tasks instead of --tasks: one after another, in reverse order, without
    practising earlier ones, or all from the start."""
    preset: Literal["quick", "desk", "paper"] = "desk"
    """Size of the runs."""
    seeds: tuple[int, ...] | None = None
    """Seeds; the preset's by default."""
    block: int = 5
    """Seeds per job. Another number makes other runs."""
    episodes: int | None = None
    """Training episodes; the preset's by default. The task starts are scaled in proportion."""
    eval_every: int | None = None
    """Training episodes between evaluations; the preset's by default."""
    held_out: Literal["validation", "test"] = "validation"
    """Half of the held-out demonstrations to test on: validation to choose settings, test to report
    results."""
    out: Path = Path("runs/sweep")
    """Parent of the run directories."""
    address: str = "local"
    """Address of a Ray cluster; "local" starts Ray on this machine."""
    cpus_per_run: float = 1
    """Cores that Ray reserves per run."""
    gpus_per_run: float = 0
    """GPUs per run, or a share of one; with 0, networks are on the CPU."""


@dataclass(frozen=True)
class DoctorArguments(ImportArguments):
    """Check this machine and installation, a line for each check.

    A line begins with ok, with look for what to look into, or with wrong for unusable, with which
    the exit status is 1.
    """

    frame: Path | None = None
    """PNG file to write what the robot sees to."""
    scene: str = "nico"
    """Robot to check beside the machine, nico or one that the module of --import adds."""


@dataclass(frozen=True)
class ReportArguments:
    """Write tables and figures of runs: those in a folder, or single ones, of any algorithms.

    Prints and writes tables.md: success, differences between algorithms, forgetting and transfer,
    learning times, groups of behaviors, cost, and each run task by task; beside it, figures. Runs
    that differ in their seeds alone, such as the jobs of a cluster, are reported as one. The report
    of a single run is written into its directory. With --archive, first copies what reports read of
    the runs, compressed, and writes the report beside the copies. docs/benchmark.md defines the
    measures.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or run directories."""
    out: Path | None = None
    """Folder of the report; by default that of the runs."""
    archive: Path | None = None
    """Folder for compact copies of the runs, on which the report is then made."""


@dataclass(frozen=True)
class WatchArguments(ImportArguments):
    """Film the trained policies of a run beside new demonstrations that they are shown.

    Writes film.gif, and its frames as a strip film.png, into the run's figures/: for each task the
    demonstration, the policy's observations and a view of the robot, framed green on success and
    red on timeout. NICO starts from the same scene in every task, so only the demonstration makes
    the difference.
    """

    run: tyro.conf.Positional[Path]
    """Run directory."""
    run_seed: int | None = None
    """Seed of the run whose policy acts; the first by default."""
    scene_seed: int = 1
    """Seed of demonstrations and starts; the pretrained encoders were trained on seed 0."""
    out: Path | None = None
    """Folder for the pictures; figures/ of the run by default."""


@dataclass(frozen=True)
class OneShotArguments(ImportArguments):
    """Show a trained policy one film, print what it recognizes, and play a task if one is named."""

    run: tyro.conf.Positional[Path]
    """Run directory."""
    demonstration: Path
    """Film of a demonstration, or folder of its frames as images; at the rate of the robot."""
    crop: tuple[int, int, int, int] | None = None
    """Top, left, height and width (pixels) of what to keep of the frames."""
    task: str | None = None
    """Task by which the simulation counts success; policies of BGPO are not told it."""
    run_seed: int | None = None
    """Seed of the run whose policy acts; the first by default."""
    scene_seed: int = 1
    """Seed of the start."""


@dataclass(frozen=True)
class GroupsArguments(BankArguments):
    """Measure the groups of behaviors that form from demonstrations, without learning a policy.

    Shows demonstrations in the order of training episodes, in four schedules, and prints by seed:
    how many groups there are at the end; how pure they are on held-out demonstrations; how many
    different demonstrations of its own each task needed before it had a group (the most demanding
    task); how long grouping took; the nodes of GWR-B, and in how many held-out demonstrations it
    infers the task. Below the table are the tasks that share a group (`sharing`, of held-out
    demonstrations), with the number of networks in which they do.
    """

    draws: int = 1_800
    """Demonstrations that each network is shown."""
    group_evidence: float = BGPOConfig().group_evidence
    """Depth of the valley of density between two groups, as --algorithm.group-evidence of a run."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the draws."""
