"""The paper's experiments: what they run and which files they write."""

import csv
import importlib.metadata
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from bgpo_trl.algorithms import ABLATIONS, ALGORITHMS
from bgpo_trl.experiments import run as experiment
from bgpo_trl.experiments.arguments import AblationArguments, Arguments
from bgpo_trl.experiments.paper import ablation, concurrent, continual
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.runs.results import read_final_tests, read_table, read_tests
from suites import nico
from tests.helpers import Recorder, contents

ROOT = Path(__file__).parents[2]
TASKS = nico.PAPER_TASKS
WITH_GROUPS = ("bgpo", "bgpo-experts", "group-balanced-replay")
WITHOUT_GWR = ("maml", "dist-nll", "oracle", "ddpg", "fine-tuning", "ewc")
WITHOUT_GWR += ("without-gwr", "without-both")


def test_an_experiment_writes_curves_figures_and_a_summary(tiny, tmp_path):
    run = tmp_path / "a run"
    printed = concurrent(Arguments(out=run))
    assert "GWR-B nodes: [" in printed and "groups of behaviors: [" in printed
    assert f"curve and figures: {run}" in printed
    assert shlex.split(printed)[-3:] == ["bgpo", "report", str(run)]
    for name in ("success.png", "gwr.png", "gwr_growth.png", "groups.png", "episodes.png"):
        assert (run / "figures" / name).read_bytes().startswith(b"\x89PNG")
    assert json.loads((run / "config.json").read_text())["task_starts"] == [0, 0, 0]
    assert set(read_tests(run / "eval.csv")["task"]) == set(TASKS)

    tests = read_final_tests(run / "final.csv")
    keys = tests[["seed", "demonstrations", "task"]].itertuples(index=False, name=None)
    assert sorted(keys) == sorted(
        (seed, kind, task) for seed in (3, 8) for kind in ("seen", "held-out") for task in TASKS
    )
    assert set(2 * tests["success"]) <= {0, 1, 2}
    assert tests["task_inference"].between(0, 1).all()
    summary = json.loads((run / "summary.json").read_text())
    assert re.fullmatch(r"|[0-9a-f]{7,}(-dirty)?", summary["commit"])
    assert summary["versions"]["torch"] == importlib.metadata.version("torch")
    assert summary["random_success"] == pytest.approx(
        dict(zip(TASKS, [0.1, 0.2, 0.3], strict=True))
    )
    nodes = read_table(run / "gwr.csv")
    assert nodes.shape == (summary["nodes"][0], 34)
    assert set(nodes["task"]) <= {"-1", "0", "1", "2"}
    assert set(nodes["group"].astype(int)) <= set(range(summary["groups"][0]))

    before = contents(run)
    with pytest.raises(ValueError, match="holds a run: --resume continues it, --out names another"):
        concurrent(Arguments(out=run))
    assert contents(run) == before


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_runs_and_is_reported_under_its_name(tiniest, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    if name in ABLATIONS:
        printed, run = ablation(AblationArguments(variant=name)), f"runs/ablation-{name}-quick"
    else:
        printed, run = concurrent(Arguments(algorithm=name)), f"runs/concurrent-{name}-quick"
    run = Path(run)
    assert f"curve and figures: {run}" in printed
    config = json.loads((run / "config.json").read_text())
    assert (config["name"], config["task_starts"]) == (name, [0, 0, 0])
    for file in ("train.csv", "eval.csv"):
        table = read_table(run / file)
        assert (set(table["algorithm"]), set(table["task"])) == ({name}, set(TASKS))
    learner = load_checkpoint(run / "checkpoint")["algorithm"]
    with_gwr, with_groups = not name.startswith(WITHOUT_GWR), name in WITH_GROUPS
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["nodes"] is not None) == ("gwr" in learner) == with_gwr
    assert (summary["groups"] is not None) == ("groups" in learner) == with_groups
    for file in ("gwr.csv", "figures/gwr.png"):
        assert (run / file).exists() == with_gwr
    assert (run / "figures/groups.png").exists() == with_groups
    assert ("GWR-B" in printed) == ("task inference" in printed) == with_gwr
    tests = read_final_tests(run / "final.csv")
    assert (tests["task_inference"].notna() == with_gwr).all()

    reported = report(ReportArguments((run,)))
    assert ("## GWR-B, by seed" in reported) == with_gwr
    assert ("one for all" in reported) == (with_gwr and not with_groups)
    assert "nan" not in reported
    trained = tests.groupby(["task", "demonstrations"])["success"].mean()
    lines = [line.split(" | ") for line in reported.splitlines() if line.startswith("| ")]
    for task in TASKS:
        (row,) = (line for line in lines if line[0] == f"| {task}")
        for cell, kind in ((row[5], "seen"), (row[6], "held-out")):
            assert float(cell) == pytest.approx(100 * trained[task, kind], abs=0.05)


def test_a_finished_run_is_only_changed_by_making_it_longer(undrawn, tmp_path, monkeypatch):
    run = tmp_path / "run"
    arguments = Arguments(out=run)
    continual(arguments)
    before, played = contents(run), (run / "train.csv").read_text()
    again = replace(arguments, resume=True)
    with monkeypatch.context() as patch:
        for name in ("load_pretrained", "make_pretrained", "Trainer", "measure", "draw"):
            patch.delattr(experiment, name)
        for same in (again, replace(again, episodes=6), replace(again, train_encoders=True)):
            assert continual(same).startswith(f"{run} is finished, all 6 episodes")
    assert contents(run) == before

    others = [{"episodes": 5}, {"seeds": (3,)}, {"eval_every": 3}, {"episodes": 9, "eval_every": 3}]
    for other in others:
        with pytest.raises(ValueError, match="holds a run with other settings"):
            continual(replace(again, **other))
    with pytest.raises(ValueError, match=r"with other settings .*task_starts is \[0, 2, 4\] there"):
        concurrent(replace(again, episodes=9))
    assert contents(run) == before

    (run / "final.csv").unlink()  # as if it had been interrupted in its last tests
    continual(again)
    assert (run / "final.csv").exists()
    assert (run / "train.csv").read_text() == played

    for _ in range(2):
        printed = continual(replace(again, episodes=9))
        settings = json.loads((run / "config.json").read_text())
        assert (settings["episodes"], settings["task_starts"]) == (9, [0, 2, 4])
        assert settings["eval_every"] == 2
        assert json.loads((run / "summary.json").read_text())["episodes"] == 9
        train = (run / "train.csv").read_text()
        assert train.startswith(played)
        assert train.count("\n") == 1 + 2 * 9
    assert printed.startswith(f"{run} is finished, all 9 episodes")


def test_resume_alone_takes_the_settings_of_the_run(undrawn, tmp_path, monkeypatch):
    """A run of other settings than the preset's, also when it is extended, and in its folder."""
    run = tmp_path / "run"
    begun = Arguments(
        out=run, algorithm="bgpo-single", episodes=4, hyperparameters=("--algorithm.beta", "0.3")
    )
    continual(begun)
    played = (run / "train.csv").read_text()
    alone = Arguments(out=run, resume=True)
    assert continual(alone).startswith(f"{run} is finished, all 4 episodes")
    continual(replace(alone, episodes=5))
    config = json.loads((run / "config.json").read_text())
    assert (config["name"], config["algorithm"]["beta"]) == ("bgpo-single", 0.3)
    assert (run / "train.csv").read_text().startswith(played)
    assert (run / "train.csv").read_text().count("\n") == 1 + 2 * 5
    before = contents(run)
    with pytest.raises(ValueError, match="holds a run with other settings"):
        continual(replace(alone, algorithm="bgpo"))
    monkeypatch.chdir(run)
    assert continual(Arguments(resume=True)).startswith(f"{run} is finished, all 5 episodes")
    assert contents(run) == before
    changed = json.loads((run / "summary.json").read_text())["changed"]
    assert changed == {"beta": 0.3}


def test_the_config_of_a_run_repeats_it(undrawn, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    continual(
        Arguments(out=first, episodes=4, seeds=(8,), hyperparameters=("--algorithm.beta", "0.3"))
    )
    continual(Arguments(out=second, config=first))
    for name in ("config.json", "train.csv", "eval.csv"):
        assert (second / name).read_bytes() == (first / name).read_bytes()


def test_the_directory_is_locked_from_the_encoders_to_the_figures(
    undrawn, tmp_path, monkeypatch, other_process
):
    events, steps = [], ["load_pretrained", "measure", "draw"]
    for name in steps:
        function = getattr(experiment, name)

        def do(*args, name=name, function=function, **kwargs):
            other = other_process(tmp_path / "run")
            assert "is in use by another process" in other.communicate()[1]
            events.append(name)
            return function(*args, **kwargs)

        monkeypatch.setattr(experiment, name, do)
    continual(Arguments(out=tmp_path / "run"))
    assert events == steps
    assert not (tmp_path / "run" / "lock").exists()


@pytest.fixture
def started(monkeypatch):
    """Recorders in place of the loggers that a command starts, with what they are started with."""
    started = []

    def start(directory, *mode, **options):
        started.append((Recorder(), (directory, *mode), options))
        return started[-1][0]

    monkeypatch.setattr(experiment, "wandb_logger", start)
    monkeypatch.setattr(experiment, "tensorboard_logger", start)
    return started


def test_dashboards_get_evaluations_final_tests_and_figures(tiniest, started, tmp_path):
    run = tmp_path / "run"
    arguments = Arguments(out=run, wandb="offline", tensorboard=True)
    continual(arguments)
    figures = ["episodes.png", "groups.png", "gwr.png", "gwr_growth.png", "success.png"]
    figures += [f"{task}.gif" for task in TASKS]
    shown = [(f"figures/{Path(n).stem}", run / "figures" / n) for n in sorted(figures)]
    for task in TASKS:
        assert (run / "figures" / f"{task}.gif").read_bytes().startswith(b"GIF89a")
    trained = read_final_tests(run / "final.csv").query("demonstrations == 'held-out'")
    means = {f"final/success/{task}": s.mean() for task, s in trained.groupby("task")["success"]}
    means["final/success_mean"] = trained["success"].mean()
    tested = sorted(set(read_tests(run / "eval.csv")["episode"]))
    assert [first[0] for _, first, _ in started] == [run, run]
    for recorder, *_ in started:
        assert [step for _, step in recorder.metrics] == [*tested, 6]
        assert recorder.metrics[-1][0] == pytest.approx(means)
        assert recorder.media == shown
        assert recorder.closed

    (run / "summary.json").unlink()  # as if it had been killed when training was over
    continual(replace(arguments, tensorboard=False, resume=True))
    resumed = started[-1][0]
    assert [step for _, step in resumed.metrics] == [6]
    assert resumed.media == shown


def test_a_refused_run_starts_no_logger(undrawn, started, tmp_path):
    continual(Arguments(out=tmp_path / "run"))
    for again in ({}, {"resume": True, "seeds": (4,)}):
        with pytest.raises(ValueError, match="holds a run"):
            continual(Arguments(out=tmp_path / "run", wandb="offline", tensorboard=True, **again))
    assert started == []


@pytest.mark.slow
def test_the_smoke_preset_passes_every_stage_although_it_is_interrupted(tmp_path):
    script = str(ROOT / "benchmarks" / "continual.py")
    command = [sys.executable, script, "--preset", "smoke", "--out", "run"]
    options = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(ROOT)}, "text": True}
    with subprocess.Popen(command, stderr=subprocess.PIPE, **options) as process:
        episodes = tmp_path / "run" / "train.csv"
        while not episodes.exists() or episodes.read_bytes().count(b"\n") < 5:
            assert process.poll() is None, f"it ended early: {process.stderr.read()}"
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.stderr.read().endswith("the same command with --resume continues\n")
    assert process.returncode == os.EX_TEMPFAIL
    assert load_checkpoint(tmp_path / "run" / "checkpoint")["evaluator"]["next"] < 2

    result = subprocess.run(
        [sys.executable, script, "--out", "run", "--resume"], capture_output=True, **options
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.endswith("curve and figures: run; in numbers: bgpo report run\n")
    for name in (
        *("config.json", "train.csv", "eval.csv", "figures/success.png", "figures/gwr.png"),
        *(
            "encoders/encoders.safetensors",
            "encoders/encoders_bank.safetensors",
            "encoders/probes.json",
        ),
        "demonstrations/dataset.json",
    ):
        assert (tmp_path / "run" / name).stat().st_size > 0
    with open(tmp_path / "run" / "train.csv", newline="") as file:
        episodes = [(row["seed"], int(row["episode"])) for row in csv.DictReader(file)]
    assert sorted(episodes) == [(seed, n) for seed in "01" for n in range(1, 13)]


def test_a_run_that_was_interrupted_while_it_made_encoders_is_resumed(
    undrawn, tmp_path, monkeypatch, encoders, bank
):
    monkeypatch.setattr(experiment, "make_pretrained", lambda *_, **__: (encoders, bank))
    (tmp_path / "demonstrations").mkdir()
    arguments = Arguments(out=tmp_path, resume=True, episodes=2)
    with pytest.raises(ValueError, match="beginning of new encoders: add --train-encoders"):
        continual(arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["demonstrations"]
    continual(replace(arguments, train_encoders=True))
    assert (tmp_path / "summary.json").exists()
