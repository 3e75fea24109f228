"""Algorithms and tasks from outside the package, in commands with ``--import`` of their module."""

import json
import sys
from dataclasses import replace

import pytest

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.one_shot import OneShotArguments, one_shot
from bgpo_trl.experiments.paper import continual
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.experiments.watch import WatchArguments, watch
from bgpo_trl.plugins import import_plugin
from bgpo_trl.runs.results import read_table
from bgpo_trl.training import Trainer
from suites import nico
from suites.nico import nico as suite_nico

ALGORITHM = """
from dataclasses import dataclass

from bgpo_trl.algorithms import ALGORITHMS, Entry
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.algorithms.rl import RL, RLEntry
from bgpo_trl.algorithms.twin_critics import make_td3
from bgpo_trl.configs import BGPOConfig, TD3Config


@dataclass(frozen=True)
class QuietConfig(TD3Config):
    name: str = "quiet"


@dataclass(frozen=True)
class MineConfig(BGPOConfig):
    share: float = 0.5


class Mine(BGPO):
    def act(self, tensordict):
        acted = super().act(tensordict)
        return acted.set("action", acted["action"] * 0 + self.config.share)


RL["quiet"] = RLEntry(make_td3, QuietConfig())
published = ALGORITHMS["bgpo-single"].config
small = QuietConfig(hidden_sizes=(64,), batch_size=16, warmup_steps=8, replay_size=200)
ALGORITHMS["mine"] = Entry(
    Mine, MineConfig(**{**vars(published), "max_steps": 6, "rl": small}, share=0.25)
)
"""
TASK = """
from suites import nico
from suites.nico import moves

class AtOnce(nico.NicoTask):
    def succeeded(self, physics):
        return physics.time() > 0

    def demonstration(self, physics, random):
        return moves.push(physics, random, "white_box", "green_box")

nico.add_task("at_once", AtOnce)
"""


@pytest.fixture(autouse=True)
def folder(tiny, shipped, tmp_path, monkeypatch):
    """The current folder, with two modules in it that are forgotten after the test."""
    (tmp_path / "my_algorithm.py").write_text(ALGORITHM)
    (tmp_path / "at_once_tasks.py").write_text(TASK)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    yield tmp_path
    forget()


def forget():
    """Forgets the modules, as a new process would."""
    ALGORITHMS.pop("mine", None), RL.pop("quiet", None), suite_nico._TASKS.pop("at_once", None)
    sys.modules.pop("my_algorithm", None), sys.modules.pop("at_once_tasks", None)


def test_an_algorithm_of_a_module_is_trained_and_filmed(undrawn, folder):
    with pytest.raises(ValueError, match="'mine'"):
        continual(Arguments(algorithm="mine"))
    continual(Arguments(algorithm="mine", module="my_algorithm"))
    run = folder / "runs" / "continual-mine-quick"
    assert set(read_table(run / "eval.csv")["algorithm"]) == {"mine"}
    assert json.loads((run / "config.json").read_text())["algorithm"]["share"] == 0.25

    forget()
    with pytest.raises(ValueError, match="name the module that adds it with --import"):
        watch(WatchArguments(run))
    watch(WatchArguments(run, module="my_algorithm"))
    assert (run / "figures" / "film.gif").exists()


def test_a_run_of_a_task_of_a_module_is_reported_filmed_and_tested(
    folder, bank, encoders, make_config
):
    run = folder / "run"
    import_plugin("at_once_tasks")
    config = make_config(tasks=("at_once",), task_starts=(0,), episodes=4)
    own = replace(bank.for_tasks(nico.PAPER_TASKS[:1]), tasks=("at_once",))
    with Trainer(config, run, bank=own, encoders=encoders, progress=False) as trainer:
        trainer.run()
    forget()
    with pytest.raises(ValueError, match="added by the module 'at_once_tasks'"):
        watch(WatchArguments(run))
    assert "| at_once |" in report(ReportArguments((run,)))  # needs no module

    learned, *outcomes = watch(WatchArguments(run, module="at_once_tasks")).splitlines()
    assert learned == "seed 3 after 4 training episodes"
    assert outcomes == ["at_once: success after 1 steps", f"pictures: {run / 'figures'}"]

    one_shot(OneShotArguments(run=run, shares=(1.0,), episodes=2, module="at_once_tasks"))
    table = read_table(run / "one_shot.csv")[["seed", "task", "success"]]
    assert table.to_numpy().tolist() == [["3", "at_once", "1.0"], ["8", "at_once", "1.0"]]
