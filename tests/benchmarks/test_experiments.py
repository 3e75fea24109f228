"""The paper's experiments: what they run and what they leave behind."""

import csv
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import concurrent_tasks, continual, report
from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.experiments import measure
from bgpo_trl.experiments import run as experiment
from bgpo_trl.experiments.arguments import Arguments, command_line
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.runs.results import read_final_tests, read_table, read_tests
from suites import nico
from tests.folders import contents

ROOT = Path(__file__).parents[2]
TASKS = nico.PAPER_TASKS


def test_continual_leaves_curve_and_figures(tiny, tmp_path, capsys):
    continual.main(Arguments(out=tmp_path / "run"))
    run_directory = tmp_path / "run"
    for name in ("success.png", "gwr.png", "gwr_growth.png", "groups.png"):
        assert (run_directory / "figures" / name).read_bytes().startswith(b"\x89PNG")
    assert json.loads((run_directory / "config.json").read_text())["episodes"] == 6
    printed = capsys.readouterr().out
    assert "GWR-B nodes: [" in printed
    assert "groups of behaviors: [" in printed
    assert f"curve and figures: {run_directory}" in printed

    before = contents(run_directory)
    with pytest.raises(ValueError, match="holds a run: --resume continues it, --out names another"):
        continual.main(Arguments(out=run_directory))
    assert contents(run_directory) == before


def test_concurrent_presents_all_tasks_from_the_start(tiny, tmp_path, capsys, monkeypatch):
    run, asked, test = tmp_path / "run", [], measure._final_tests
    monkeypatch.setattr(measure, "_final_tests", lambda *a, **b: asked.append(b) or test(*a, **b))
    concurrent_tasks.main(Arguments(out=run))
    assert asked == [{"episodes": 20}]  # of which `tiny` leaves two
    assert json.loads((run / "config.json").read_text())["task_starts"] == [0, 0, 0]
    assert set(read_tests(run / "eval.csv")["task"]) == set(TASKS)

    tests = read_final_tests(run / "final.csv")
    keys = tests[["seed", "demonstrations", "task"]].itertuples(index=False, name=None)
    assert sorted(keys) == sorted(
        (seed, kind, task) for seed in (3, 8) for kind in ("seen", "held-out") for task in TASKS
    )
    assert set(tests["episodes"]) == {"2"}
    assert set(2 * tests["success"]) <= {0, 1, 2}
    assert tests["task_inference"].between(0, 1).all()
    told = json.loads((run / "summary.json").read_text())
    assert re.fullmatch(r"|[0-9a-f]{7,}(-dirty)?", told["commit"])
    assert len(told["nodes"]) == 2
    assert told["random_success"] == pytest.approx(dict(zip(TASKS, [0.1, 0.2, 0.3], strict=True)))
    nodes = read_table(run / "gwr.csv")
    assert nodes.shape == (told["nodes"][0], 34)
    assert set(nodes["task"]) <= {"-1", "0", "1", "2"}
    assert set(nodes["group"].astype(int)) <= set(range(told["groups"][0]))
    assert (run / "figures" / "episodes.png").read_bytes().startswith(b"\x89PNG")

    capsys.readouterr()
    report.main(report.Arguments((run,)))
    printed = capsys.readouterr().out
    late = read_tests(run / "eval.csv").groupby("task")["success"].mean()  # tested once
    for task in TASKS:
        assert f"| {task} | {100 * late[task]:.1f}" in printed
    assert (run / "concurrent-3.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_command_line_runs_every_algorithm_and_says_its_name(
    tiniest, monkeypatch, tmp_path, capsys, name
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["concurrent_tasks.py", "--algorithm", name])
    runpy.run_path(str(ROOT / "benchmarks" / "concurrent_tasks.py"), run_name="__main__")
    run = Path("runs") / f"concurrent-{name}-quick"
    printed = capsys.readouterr().out
    assert f"curve and figures: {run}" in printed
    config = json.loads((run / "config.json").read_text())
    assert config["name"] == name
    assert config["algorithm"].get("beta") == (
        None if name.startswith(("maml", "dist-nll")) else 0.1
    )
    for file in ("train.csv", "eval.csv"):
        table = read_table(run / file)
        assert set(table["algorithm"]) == {name}
        assert set(table["task"]) == set(TASKS)

    # Lines on GWR-B appear only with algorithms that have one.
    with_gwr = name.startswith("bgpo")
    told = json.loads((run / "summary.json").read_text())
    assert (told["nodes"] is not None) == with_gwr
    for file in ("gwr.csv", "figures/gwr.png"):
        assert (run / file).exists() == with_gwr
    # And of groups, where behaviors are told apart.
    with_groups = name in ("bgpo", "bgpo-experts")
    assert (told["groups"] is not None) == (run / "figures/groups.png").exists() == with_groups
    if with_gwr:
        assert ("group" in read_table(run / "gwr.csv")) == with_groups
    assert ("GWR-B" in printed) == ("task inference" in printed) == with_gwr
    tests = read_final_tests(run / "final.csv")
    assert len(tests) == 2 * 2 * 3
    assert (tests["task_inference"].notna() == with_gwr).all()
    report.main(report.Arguments((run,)))
    reported = capsys.readouterr().out
    assert ("## GWR-B, by seed" in reported) == with_gwr
    assert ("one for all" in reported) == (with_gwr and not with_groups)
    assert "nan" not in reported
    trained = tests.groupby(["task", "demonstrations"])["success"].mean()
    lines = [line.split(" | ") for line in reported.splitlines() if line.startswith("| ")]
    for task in TASKS:
        (row,) = (line for line in lines if line[0] == f"| {task}")
        assert (row[7] != "") == with_gwr
        for cell, kind in ((row[5], "seen"), (row[6], "held-out")):
            assert float(cell) == pytest.approx(100 * trained[task, kind], abs=0.05)


def test_a_finished_run_only_says_so_until_it_is_made_longer(
    undrawn, tmp_path, monkeypatch, capsys
):
    run = tmp_path / "run"
    arguments = Arguments(out=run)
    continual.main(arguments)
    before, played = contents(run), (run / "train.csv").read_text()
    again = replace(arguments, resume=True)
    with monkeypatch.context() as patch:
        for name in ("load_pretrained", "make_pretrained", "Trainer", "measure", "draw"):
            patch.delattr(experiment, name)
        for same in (again, replace(again, episodes=6), replace(again, train_encoders=True)):
            capsys.readouterr()
            continual.main(same)
            told = f"{run} is finished, all 6 episodes: --episodes makes it longer\n"
            assert capsys.readouterr() == (told, "")
    assert contents(run) == before

    others = [{"episodes": 5}, {"seeds": (3,)}, {"eval_every": 3}, {"episodes": 9, "eval_every": 3}]
    for other in others:
        with pytest.raises(ValueError, match="holds a run with other settings"):
            continual.main(replace(again, **other))
    with pytest.raises(ValueError, match=r"with other settings .*task_starts is \[0, 2, 4\] there"):
        concurrent_tasks.main(replace(again, episodes=9))
    assert contents(run) == before

    (run / "final.csv").unlink()  # as if it had been interrupted in its last tests
    continual.main(again)
    assert (run / "final.csv").exists()
    assert (run / "train.csv").read_text() == played

    for _ in range(2):
        capsys.readouterr()
        continual.main(replace(again, episodes=9))
        settings = json.loads((run / "config.json").read_text())
        assert (settings["episodes"], settings["task_starts"]) == (9, [0, 2, 4])
        assert settings["eval_every"] == 2
        assert json.loads((run / "summary.json").read_text())["episodes"] == 9
        train = (run / "train.csv").read_text()
        assert train.startswith(played)
        assert train.count("\n") == 1 + 2 * 9
    assert capsys.readouterr().out.startswith(f"{run} is finished, all 9 episodes")


def test_what_is_not_there_yet_begins_when_it_is_resumed(undrawn, tmp_path, monkeypatch):
    again = Arguments(out=tmp_path / "run", resume=True, episodes=4)
    continual.main(again)
    begun = (tmp_path / "run" / "train.csv").read_text()
    assert begun.count("\n") == 1 + 2 * 4
    continual.main(again)
    assert (tmp_path / "run" / "train.csv").read_text() == begun


def test_an_interrupted_run_exits_with_a_code_of_its_own(capsys):
    def interrupted(arguments):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as left:
        command_line(interrupted, None, options=[])
    assert left.value.code == 75
    assert capsys.readouterr().err == "interrupted: the same command with --resume continues\n"


def test_a_run_that_was_interrupted_before_its_training_is_resumed(
    undrawn, tmp_path, monkeypatch, encoders, bank
):
    monkeypatch.setattr(experiment, "make_pretrained", lambda *_, **__: (encoders, bank))
    (tmp_path / "demonstrations").mkdir()
    arguments = Arguments(out=tmp_path, resume=True, episodes=2)
    with pytest.raises(ValueError, match="beginning of new encoders: add --train-encoders"):
        continual.main(arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["demonstrations"]
    continual.main(replace(arguments, train_encoders=True))
    assert (tmp_path / "summary.json").exists()


def test_another_process_is_kept_off_all_of_an_experiment(
    undrawn, tmp_path, monkeypatch, other_process
):
    """Also while it makes its encoders, and while it is tested and drawn."""
    events, steps = [], ["load_pretrained", "measure", "draw"]
    for name in steps:
        function = getattr(experiment, name)

        def do(*args, name=name, function=function, **kwargs):
            other = other_process(tmp_path / "run")
            assert "is in use by another process" in other.communicate()[1]
            events.append(name)
            return function(*args, **kwargs)

        monkeypatch.setattr(experiment, name, do)
    continual.main(Arguments(out=tmp_path / "run"))
    assert events == steps
    assert not (tmp_path / "run" / "lock").exists()


def test_a_dashboard_gets_the_figures_before_it_is_closed(tiniest, monkeypatch, tmp_path):
    events = []

    class Dashboard:
        def __init__(self, *args, **kwargs): ...

        def log_metrics(self, metrics, step):
            events.append("row")

        def shutdown(self):
            events.append("shutdown")

    monkeypatch.setattr("bgpo_trl.runs.logger.WandbLogger", Dashboard)
    monkeypatch.setattr(
        "bgpo_trl.runs.logger._log_wandb_media", lambda dashboard, *media: events.append(media)
    )
    run = tmp_path / "run"
    figures = ["episodes.png", "groups.png", "gwr.png", "gwr_growth.png", "success.png"]
    figures += [f"{task}.gif" for task in TASKS]
    shown = [(f"figures/{Path(n).stem}", run / "figures" / n) for n in sorted(figures)]
    arguments = Arguments(out=run, wandb="offline")
    continual.main(arguments)
    tables = [read_table(run / name) for name in ("train.csv", "eval.csv")]
    assert events == ["row"] * sum(map(len, tables)) + [*shown, "shutdown"]
    for task in TASKS:
        assert (run / "figures" / f"{task}.gif").read_bytes().startswith(b"GIF89a")

    events.clear()
    (run / "summary.json").unlink()  # as if it had been killed when training was over
    continual.main(replace(arguments, resume=True))
    assert events == [*shown, "shutdown"]


@pytest.mark.slow
def test_smoke_goes_through_every_stage_from_nothing(tmp_path):
    """Interrupted once on the way, like a person would: the same command goes on."""
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

    result = subprocess.run([*command, "--resume"], capture_output=True, **options)
    assert result.returncode == 0, result.stderr
    told = "curve and figures: run; in numbers: python benchmarks/report.py run\n"
    assert result.stdout.endswith(told)
    for name in (
        *("config.json", "train.csv", "eval.csv", "figures/success.png", "figures/gwr.png"),
        *("encoders/nico.safetensors", "encoders/nico_bank.safetensors", "encoders/probes.json"),
        "demonstrations/dataset.json",
    ):
        assert (tmp_path / "run" / name).stat().st_size > 0
    with open(tmp_path / "run" / "train.csv", newline="") as file:
        episodes = [(row["seed"], int(row["episode"])) for row in csv.DictReader(file)]
    assert sorted(episodes) == [(seed, n) for seed in "01" for n in range(1, 13)]
