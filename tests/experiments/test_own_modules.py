"""Algorithms and tasks from outside the package, in commands with ``--import`` of their module."""

import json
import re
import sys
from dataclasses import replace

import pytest
from one_shot import OneShotArguments, one_shot

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.data import recording
from bgpo_trl.experiments import run as experiment
from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.command_line import import_plugin
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.experiments.run import continual
from bgpo_trl.experiments.watch import WatchArguments, watch
from bgpo_trl.runs.results import read_table
from suites import nico
from suites.nico import nico as suite_nico

MODULE = """
from dataclasses import dataclass, field

from bgpo_trl.algorithms import ALGORITHMS, Entry
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.configs import BGPOConfig, RLConfig
from suites import nico
from suites.nico import moves


@dataclass(frozen=True)
class QuietConfig(RLConfig):
    quiet: float = 0.75


@dataclass(frozen=True)
class MineConfig(BGPOConfig):
    share: float = 0.5
    rl: QuietConfig = field(default_factory=QuietConfig)


class Mine(BGPO):
    def act(self, tensordict):
        acted = super().act(tensordict)
        return acted.set("action", acted["action"] * 0 + self.config.share)


class AtOnce(nico.NicoTask):
    def succeeded(self, physics):
        return physics.time() > 0

    def demonstration(self, physics, random):
        return moves.push(physics, random, "white_box", "green_box")


published = ALGORITHMS["bgpo-single"].config
small = QuietConfig(
    hidden_sizes=(64,), batch_size=16, warmup_steps=8, replay_size=200, quiet=0.5
)
ALGORITHMS["mine"] = Entry(
    Mine, MineConfig(**{**vars(published), "max_steps": 6, "rl": small}, share=0.25)
)
nico.add_task("at_once", AtOnce)
"""


@pytest.fixture(autouse=True)
def folder(undrawn, shipped, tmp_path, monkeypatch):
    """The current folder, with modules in it that are forgotten after the test."""
    (tmp_path / "mine_at_once.py").write_text(MODULE)
    (tmp_path / "astray.py").write_text("import no_such_library\n")
    (tmp_path / "json.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    yield tmp_path
    forget()


def forget():
    """Forgets the module, as a new process would."""
    ALGORITHMS.pop("mine", None), suite_nico._TASKS.pop("at_once", None)
    sys.modules.pop("mine_at_once", None)


def test_a_task_and_an_algorithm_of_a_module_are_trained_reported_filmed_and_tested(
    folder, encoders, bank, monkeypatch
):
    own = replace(bank.for_tasks(nico.PAPER_TASKS[:1]), tasks=("at_once",))
    monkeypatch.setattr(experiment, "load_pretrained", lambda *_, **__: (encoders, own))
    monkeypatch.setattr(recording, "check_scene", lambda *_: [])  # which refuses such a task
    asked = Arguments(algorithm="mine", tasks=("at_once",), episodes=4)
    with pytest.raises(ValueError, match="'mine'"):
        continual(asked)
    import_plugin("mine_at_once")
    continual(asked)
    run = folder / "runs" / "continual-mine-quick"
    assert set(read_table(run / "eval.csv")["algorithm"]) == {"mine"}
    stored = json.loads((run / "config.json").read_text())["algorithm"]
    assert (stored["share"], stored["rl"]["quiet"]) == (0.25, 0.5)

    forget()
    assert "| at_once |" in report(ReportArguments((run,)))  # needs no module
    with pytest.raises(ValueError, match="name the module that adds it with --import"):
        watch(WatchArguments(run))
    import_plugin("mine_at_once")
    learned, *outcomes = watch(WatchArguments(run)).splitlines()
    assert learned == "seed 3 after 4 of 4 episodes"
    assert outcomes == ["at_once: success after 1 steps", f"pictures: {run / 'figures'}"]

    one_shot(OneShotArguments(run=run, shares=(1.0,), episodes=2))
    table = read_table(run / "one_shot.csv")[["seed", "task", "success"]]
    assert table.to_numpy().tolist() == [[3, "at_once", 1.0], [8, "at_once", 1.0]]


@pytest.mark.parametrize(
    "name", ["mine", "mine_at_once.py", "mine_at_once.tasks", "no.such", "./mine", ".mine", ""]
)
def test_a_missing_module_is_refused(folder, name):
    message = rf"^--import {re.escape(name)}: there is no such module in {folder}"
    with pytest.raises(ValueError, match=message):
        import_plugin(name)


def test_an_import_error_within_the_module_is_raised_unchanged():
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        import_plugin("astray")


def test_a_module_hidden_by_another_one_is_refused():
    with pytest.raises(ValueError, match=r"^--import json: .*json.* has the same name: rename "):
        import_plugin("json")
    assert "mine" not in ALGORITHMS
