"""Scripts that read a run of a task from outside the suite, with ``--import`` of its module."""

import csv
import sys
from dataclasses import replace

import one_shot
import pytest
import report

from bgpo_trl.experiments.watch import WatchArguments, watch
from bgpo_trl.plugins import import_plugin
from bgpo_trl.training import Trainer
from suites import nico
from suites.nico import nico as suite_nico

OWN = """
from suites import nico
from suites.nico import moves

class AtOnce(nico.NicoTask):
    def succeeded(self, physics):
        return physics.time() > 0

    def demonstration(self, physics, random):
        return moves.push(physics, random, "white_box", "green_box")

nico.add_task("at_once", AtOnce)
"""


@pytest.fixture
def run(bank, encoders, make_config, tmp_path, monkeypatch):
    """A finished run of the task, in a process that does not know it any more."""
    (tmp_path / "at_once_tasks.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    place = "bgpo_trl.runs.demonstrations.load_representation"
    monkeypatch.setattr(place, lambda path, scene_version: encoders)
    import_plugin("at_once_tasks")
    config = make_config(tasks=("at_once",), task_starts=(0,), episodes=4)
    own = replace(bank.for_tasks(nico.PAPER_TASKS[:1]), tasks=("at_once",))
    with Trainer(config, tmp_path / "run", bank=own, encoders=encoders, progress=False) as trainer:
        trainer.run()
    suite_nico._TASKS.pop("at_once")
    sys.modules.pop("at_once_tasks")
    yield tmp_path / "run"
    sys.modules.pop("at_once_tasks", None)


def test_a_run_is_filmed_tested_and_summed_up_where_its_module_is_named(run, capsys):
    with pytest.raises(ValueError, match="'at_once', added by the module 'at_once_tasks': name"):
        watch(WatchArguments(run))
    report.main(report.Arguments((run,)))  # Needs no module.
    assert "| at_once |" in capsys.readouterr().out

    told = watch(WatchArguments(run, module="at_once_tasks"))
    learned, *told = told.splitlines()
    assert learned == "seed 3 after 4 training episodes"
    assert told == ["at_once: success after 1 steps", f"pictures: {run / 'figures'}"]

    one_shot.main(one_shot.Arguments(run, (1.0,), episodes=2, module="at_once_tasks"))
    with (run / "one_shot.csv").open(newline="") as file:
        tested = [(row["seed"], row["task"], row["success"]) for row in csv.DictReader(file)]
    assert tested == [("3", "at_once", "1.0"), ("8", "at_once", "1.0")]
