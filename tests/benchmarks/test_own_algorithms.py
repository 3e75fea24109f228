"""Algorithms from outside the package: scripts find them with ``--import`` of their module."""

import json
import sys
from dataclasses import replace

import continual
import pytest
import sweep
import torch

from bgpo_trl.algorithms import ALGORITHMS, entry
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.experiments.arguments import Arguments, command_line, run_config
from bgpo_trl.experiments.watch import WatchArguments, watch
from bgpo_trl.runs.results import read_table
from suites import nico

OWN = """
from dataclasses import dataclass

from bgpo_trl.algorithms import ALGORITHMS, Entry
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.algorithms.rl import RL, RLEntry, make_td3
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


@pytest.fixture(autouse=True)
def folder(tiny, tmp_path, monkeypatch):
    """The current folder, with a module in it that is forgotten after the test."""
    (tmp_path / "my_algorithm.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    yield tmp_path
    for registry, name in ((ALGORITHMS, "mine"), (RL, "quiet")):
        registry.pop(name, None)
    sys.modules.pop("my_algorithm", None)


def forget():
    """Forgets the module, as a new process would."""
    ALGORITHMS.pop("mine")
    sys.modules.pop("my_algorithm")


def test_an_algorithm_of_a_module_runs_and_is_filmed(
    undrawn, folder, encoders, monkeypatch, capsys
):
    place = "bgpo_trl.runs.demonstrations.load_representation"
    monkeypatch.setattr(place, lambda path, scene_version: encoders)
    with pytest.raises(ValueError, match=r"^--algorithm: there is no 'mine'; name one of bgpo, "):
        continual.main(Arguments(algorithm="mine"))
    continual.main(Arguments(algorithm="mine", module="my_algorithm"))
    run = folder / "runs" / "continual-mine-quick"
    assert str(run.relative_to(folder)) in capsys.readouterr().out
    assert set(read_table(run / "eval.csv")["algorithm"]) == {"mine"}
    told = json.loads((run / "config.json").read_text())
    assert told["algorithm"]["share"] == 0.25

    forget()
    with pytest.raises(ValueError, match=r"is a run of 'mine', whose .* name the module that adds"):
        watch(WatchArguments(run))
    watch(WatchArguments(run, module="my_algorithm"))
    assert (run / "figures" / "nico.gif").exists()


def test_an_rl_algorithm_of_a_module_is_named_alike():
    with pytest.raises(ValueError, match=r"^--rl: there is no 'quiet'; name one of ddpg, td3"):
        run_config(Arguments(rl="quiet"))
    config = run_config(Arguments(rl="quiet", module="my_algorithm"))
    assert config.algorithm.rl == RL["quiet"].config


def test_an_rl_algorithm_of_its_own_is_kept_unless_another_is_named():
    own = Arguments(algorithm="mine", module="my_algorithm")
    assert run_config(own).algorithm == ALGORITHMS["mine"].config
    assert ALGORITHMS["mine"].config.rl.name == "quiet"
    assert run_config(replace(own, rl="sac")).algorithm.rl == RL["sac"].config


def test_a_grid_has_an_algorithm_of_a_module(folder):
    arguments = sweep.Arguments(
        algorithms=("mine",), settings=("eight", "concurrent"), module="my_algorithm", out=folder
    )
    with pytest.raises(ValueError, match=r"^--algorithm: there is no 'mine'"):
        sweep.make_jobs(arguments)
    run_config(Arguments(module="my_algorithm"))
    grid = {path.name: group[0] for path, group in sweep.make_jobs(arguments).items()}
    assert list(grid) == ["eight-mine", "concurrent-mine"]
    assert [job.config.tasks for job in grid.values()] == [nico.ALL_TASKS, nico.PAPER_TASKS]
    for job in grid.values():
        assert (job.module, job.config.name) == ("my_algorithm", "mine")
        assert job.config.algorithm == ALGORITHMS["mine"].config


def test_the_name_of_a_variant_is_not_free(monkeypatch):
    monkeypatch.setitem(ALGORITHMS, "experts", ALGORITHMS["maml"])
    with pytest.raises(ValueError, match="'experts' is a variant of BGPO: add your algorithm"):
        entry("experts")


def test_an_error_of_own_code_keeps_its_traceback_unless_it_misuses_the_package():
    def broken(arguments):
        raise ValueError("mine is broken")

    def of_a_library(arguments):
        torch.zeros(2) @ torch.zeros(3)

    def misuse(arguments):
        BGPOConfig(beta=-1.0)

    for main, message in ((broken, "mine is broken"), (of_a_library, "size")):
        with pytest.raises((ValueError, RuntimeError), match=message):
            command_line(main, None, options=[])
    with pytest.raises(SystemExit, match=r"^error: beta must be at least 0"):
        command_line(misuse, None, options=[])
