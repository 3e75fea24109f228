"""Arguments that several commands share, in a module that is quick to import."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class ImportArguments:
    """Own tasks and algorithms in a command."""

    module: Annotated[str | None, tyro.conf.arg(name="import")] = None
    """Module that adds scenes (SCENES), tasks (nico.add_task) or algorithms (ALGORITHMS), imported
    first; here or installed."""


@dataclass(frozen=True, kw_only=True)
class TrainedArguments(ImportArguments):
    """Tests of the policies of a run."""

    run: tyro.conf.Positional[Path]
    """Run directory."""
    episodes: int = 20
    """Test episodes per task and seed, in each condition."""
    out: Path | None = None
    """Folder to write to; the run directory by default."""
    threads: int = 1
    """Threads of PyTorch."""


@dataclass(frozen=True, kw_only=True)
class BankArguments(ImportArguments):
    """Tasks and their demonstrations."""

    scene: str | None = None
    """Robot with its tasks, nico by default, or one that the module of --import adds."""
    tasks: tuple[str, ...] | None = None
    """Tasks in the order of presentation, or "all" for all of the scene; by default its usual ones,
    for NICO the paper's three. In runs, unless there are three, they start at even intervals."""
    encoders: Path | None = None
    """Encoders trained by bgpo_trl.encoders.train, with their bank beside them; those that come
    with the scene by default. With --resume, the run's own."""
    bank: Path | None = None
    """Demonstrations embedded by bgpo_trl.encoders.make_bank; for tasks missing in it, those beside
    the encoders are used. With --resume, the run's own by default."""


@dataclass(frozen=True)
class Arguments(BankArguments):
    """A run. Flags go before the file of --config, and this before --preset.

    Hyperparameters of the algorithm are flags too, by their names in config.json, such as
    --algorithm.beta 0.2 or --algorithm.rl.noise 0.1.
    """

    algorithm: str | None = None
    """bgpo, the default; bgpo-experts: without demonstrations as experience; bgpo-single: without
    experts too; maml and dist-nll: the baselines; bgpo-paper, maml-paper, dist-nll-paper: as
    published; oracle and ddpg: DDPG with the task label as context, and without context;
    fine-tuning and ewc: DDPG without context that is given task boundaries, best with --schedule
    sequential; maml, dist-nll, oracle or fine-tuning followed by -demonstrations: with
    demonstrations as experience; a variant of `bgpo ablation`; or one that the module of --import
    adds."""
    rl: str | None = None
    """The RL algorithm of BGPO, its ablations and the references: ddpg, td3, sac, or one that the
    module of --import adds; DDPG by default."""
    preset: Literal["smoke", "quick", "desk", "paper"] | None = None
    """Size of the run, with its time on two cores: smoke (12 episodes of 2 seeds, every stage in 2
    minutes), quick (1,800 episodes of 2 seeds, 15 minutes), the default; desk (6,000 episodes of 5
    seeds, two hours) or paper (20,000 episodes of 10 seeds, days)."""
    config: Path | None = None
    """YAML or JSON file of settings, named as in a run's config.json, or a run directory to repeat;
    the preset's for those that it lacks."""
    out: Path | None = None
    """Run directory; runs/EXPERIMENT-ALGORITHM[-RL]-PRESET by default, with the name of the file
    of --config for PRESET."""
    seeds: tuple[int, ...] | None = None
    """Seeds; the preset's by default."""
    schedule: Literal["practised", "sequential"] | None = None
    """Tasks of training episodes: all presented so far (practised, the default) or only the newest
    (sequential, as in Continual World and COOM)."""
    spread: float | None = None
    """Share of the whole range of start states, from 0 (nominal places) to 1, the default."""
    episodes: int | None = None
    """Training episodes; the preset's by default. The task starts are scaled in proportion. With
    --resume, a larger number extends the run, whose task starts are kept."""
    task_starts: tuple[int, ...] | None = None
    """Episodes after which tasks are presented, one for each; the preset's by default."""
    eval_every: int | None = None
    """Training episodes between evaluations; the preset's by default."""
    eval_episodes: int | None = None
    """Test episodes of each task in an evaluation; the preset's by default."""
    checkpoint_minutes: float | None = None
    """Minutes between checkpoints; the preset's by default."""
    held_out: Literal["validation", "test"] | None = None
    """Half of the held-out demonstrations to test on: validation, the default, to choose settings;
    test to report results."""
    resume: bool = False
    """Continue the run in the directory, or begin it if there is none. With --out, or in a run's
    folder, and with neither --preset nor --config, its settings are those of the run."""
    train_encoders: bool = False
    """Record demonstrations and train new encoders instead of using the pretrained ones."""
    wandb: Literal["online", "offline"] | None = None
    """Also log means over the seeds to Weights & Biases."""
    wandb_group: str | None = None
    """Group of the run on Weights & Biases; EXPERIMENT-ALGORITHM[-RL] by default."""
    tensorboard: bool = False
    """Also log these means to TensorBoard, into the run directory."""
    per_seed_curves: bool = False
    """Log the test success of each seed to them, too."""
    device: str = "auto"
    """Device of the networks: cpu, cuda, or auto for a GPU if there is one."""
    threads: int = 1
    """Threads of PyTorch; more than one slows these small networks down. Physics always uses all
    cores."""
    hyperparameters: tyro.conf.Suppress[tuple[str, ...]] = ()
    """Flags of single hyperparameters, which `run_config` reads."""


@dataclass(frozen=True)
class AblationArguments(Arguments):
    """A variant of BGPO."""

    variant: str = "bgpo-single"
    """bgpo-single: the paper's algorithm, with our stabilizers; without-bonus, without-gwr,
    without-both: without the intrinsic reward, GWR-B or both. group-balanced-replay,
    demonstrations: bgpo-single with that addition; bgpo-experts: with experts, and replay balanced
    by group; bgpo: with all three."""
    continual: bool = False
    """Tasks one after the other instead of all from the start."""
