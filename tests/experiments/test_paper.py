"""The paper's experiments: what they run and which files they write."""

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
from functools import partial
from pathlib import Path

import pytest

from bgpo_trl import training
from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.analysis.comparison import NAMES
from bgpo_trl.configs import RepresentationConfig
from bgpo_trl.encoders.pretrained import default_weights
from bgpo_trl.encoders.representation import save_representation
from bgpo_trl.experiments import measure
from bgpo_trl.experiments import run as experiment
from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.measure import success_lines
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.experiments.run import concurrent, continual
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.runs.demonstrations import own_weights
from bgpo_trl.runs.results import read_run, read_table
from bgpo_trl.scenes import SCENES
from suites import nico
from tests.helpers import Recorder, cells, contents, edit, rows, spied

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
TASKS = nico.PAPER_TASKS
FIGURES = ("success.png", "gwr.png", "groups.png", "episodes.png")
WITH_GROUPS = ("bgpo", "clone", "bgpo-experts", "group-balanced-replay")
WITHOUT_GWR = ("maml", "dist-nll", "oracle", "ddpg", "fine-tuning", "ewc")
WITHOUT_GWR += ("without-gwr", "without-both")


def json_of(run, name):
    return json.loads((run / f"{name}.json").read_text())


def test_simulations_of_final_tests_are_closed_before_there_are_more(
    tiniest, tmp_path, monkeypatch
):
    made = []

    class Watched(measure.Evaluator):
        def __init__(self, *given, **named):
            assert all(other.env.is_closed and not other.simulation.simulations for other in made)
            made.append(self)
            super().__init__(*given, **named)
            assert self.simulation.simulations

    monkeypatch.setattr(measure, "Evaluator", Watched)
    concurrent(Arguments(out=tmp_path / "run"))
    assert len(made) >= 2


def test_an_experiment_writes_curves_figures_and_a_summary(tiny, tmp_path, refused):
    run = tmp_path / "a run"
    printed = concurrent(Arguments(out=run))
    assert "docs/extending.md says where to look" in printed  # after six episodes
    assert "GWR-B nodes: [" in printed and "groups of behaviors: [" in printed
    assert shlex.split(printed)[-3:] == ["bgpo", "report", str(run)]
    figures = {path.name for path in (run / "figures").iterdir()}
    solved = read_table(run / "eval.csv")["success"].any()
    steps = ["steps.png"] if solved else []
    assert figures == {*FIGURES, *steps, *(f"{task}.gif" for task in TASKS)}

    tests = read_table(run / "final.csv")
    keys = tests[["seed", "demonstrations", "task"]].itertuples(index=False, name=None)
    assert sorted(keys) == sorted(
        (seed, kind, task) for seed in (3, 8) for kind in ("seen", "held-out") for task in TASKS
    )
    assert set(2 * tests["success"]) <= {0, 1, 2}
    assert (tests["steps"].notna() == (tests["success"] > 0)).all()
    summary = json_of(run, "summary")
    assert re.fullmatch(r"|[0-9a-f]{7,}(-dirty)?", summary["commit"])
    assert summary["versions"]["torch"] == importlib.metadata.version("torch")
    by_chance = dict(zip(TASKS, [0.1, 0.2, 0.3], strict=True))
    assert summary["random_success"] == pytest.approx(by_chance)
    again = partial(concurrent, Arguments(out=run))
    refused(again, "holds a run: --resume continues it", "--out names another")


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_runs_and_is_reported_under_its_name(tiniest, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    printed = concurrent(Arguments(algorithm=name))
    run = Path("runs", f"concurrent-{name}-quick")
    assert f"curve and figures: {run}" in printed
    config = json_of(run, "config")
    assert (config["name"], config["task_starts"]) == (name, [0, 0, 0])
    for file in ("train.csv", "eval.csv"):
        table = read_table(run / file)
        assert (set(table["algorithm"]), set(table["task"])) == ({name}, set(TASKS))
    with_gwr, with_groups = not name.startswith(WITHOUT_GWR), name in WITH_GROUPS
    summary = json_of(run, "summary")
    assert (summary["nodes"] is not None) == with_gwr
    assert (summary["groups"] is not None) == with_groups
    assert (run / "figures/gwr.png").exists() == with_gwr
    assert (run / "figures/groups.png").exists() == with_groups
    assert ("GWR-B" in printed) == with_gwr
    tests = read_table(run / "final.csv")
    assert (tests["task_inference"].notna() == with_gwr).all()

    reported = report(ReportArguments((run,)))
    assert ("one for all" in reported) == (with_gwr and not with_groups)
    assert "nan" not in reported
    trained = tests.groupby(["task", "demonstrations"])["success"].mean()
    found = {row[0]: row for row in cells(reported.split(f"## {NAMES[name]}: ")[1])}
    for task in TASKS:
        shown = [float(cell) for cell in found[task][3:5]]
        expected = [100 * trained[task, kind] for kind in ("seen", "held-out")]
        assert shown == pytest.approx(expected, abs=0.05)


def test_a_finished_run_is_only_changed_by_making_it_longer(
    undrawn, tmp_path, monkeypatch, refused
):
    run = tmp_path / "run"
    arguments = Arguments(out=run)
    continual(arguments)
    before, played = contents(run), (run / "train.csv").read_text()
    again = replace(arguments, resume=True)
    with monkeypatch.context() as patch:
        for name in ("load_pretrained", "make_pretrained", "Trainer", "measure", "draw"):
            patch.delattr(experiment, name)
        for same in (again, replace(again, episodes=6), replace(again, encoders=own_weights(run))):
            assert continual(same).startswith(f"{run} is finished, all 6 episodes")
    assert contents(run) == before

    seed, every = {"settings": ("--seeds", "3")}, {"settings": ("--eval-every", "3")}
    for other in ({"episodes": 5}, seed, every, {"episodes": 9, **every}):
        changed = partial(continual, replace(again, **other))
        refused(changed, "holds a run with other settings", "choose another")
    two = replace(again, episodes=9, tasks=TASKS[:2])
    refused(partial(continual, two), f"has the tasks {', '.join(TASKS)}", "leave the flag out")
    from_start = partial(concurrent, replace(again, episodes=9))
    refused(from_start, "task_starts is [0, 2, 4] there", "choose another")

    (run / "final.csv").unlink()  # as if it had been interrupted in its last tests
    monkeypatch.setattr(sys, "argv", ["again"])
    monkeypatch.setattr(training, "commit_of_code", lambda: "c0ffee")
    began = json_of(run, "summary")["commit"]
    continual(again)
    assert (run / "final.csv").exists()
    assert (run / "train.csv").read_text() == played
    summary = json_of(run, "summary")
    assert summary["commit"] == "; ".join(filter(None, [began, "c0ffee"]))
    assert summary["command"].endswith("; python again")

    continual(replace(again, episodes=9, encoders=own_weights(run)))
    config = json_of(run, "config")
    kept = (config["episodes"], config["task_starts"], config["eval_every"])
    assert kept == (9, [0, 2, 4], 2)
    assert json_of(run, "summary")["episodes"] == 9
    assert continual(replace(again, episodes=9)).startswith(f"{run} is finished, all 9 episodes")


@pytest.mark.parametrize("episodes", [6, 9])
def test_a_run_is_continued_or_found_finished_with_its_own_files_alone(
    undrawn, tmp_path, monkeypatch, refused, encoders, bank, episodes
):
    run, none = tmp_path / "run", tmp_path / "none.safetensors"
    continual(Arguments(out=run))
    own = {"encoder_id": encoders.identity, "scene": encoders.metadata["scene"]}
    replace(bank, embedding=bank.embedding + 1, **own).save(tmp_path / "other.safetensors")
    other_bank = {"bank": tmp_path / "other.safetensors", "encoders": own_weights(run)}
    again = Arguments(out=run, resume=True, episodes=episodes)
    for files, cause, remedy in (
        ({"encoders": default_weights()}, "was begun with the encoders", "leave the flag out"),
        ({"encoders": none}, "no encoder weights", "train some"),
        ({"train_encoders": True}, "was begun with encoders", "leave the flag out"),
        (other_bank, "bank is ", "choose another"),
        ({**other_bank, "bank": none}, "none.safetensors", "bgpo bank"),
        ({"logged": tmp_path}, str(tmp_path), ": "),
    ):
        refused(partial(continual, replace(again, **files)), cause, remedy)
    changed = replace(SCENES["nico"], version="2")
    monkeypatch.setitem(SCENES, "nico", changed)
    refused(partial(continual, again), changed.full_version, ": ")


def test_a_run_is_continued_and_repeated_with_its_own_settings(
    undrawn, tmp_path, monkeypatch, refused
):
    """A run of other settings than the preset's, also when it is extended, and in its folder."""
    run = tmp_path / "run"
    begun = Arguments(
        out=run, algorithm="bgpo-single", episodes=4, settings=("--algorithm.beta", "0.3")
    )
    continual(begun)
    played = (run / "train.csv").read_text()
    alone = Arguments(out=run, resume=True)
    assert continual(alone).startswith(f"{run} is finished, all 4 episodes")
    continual(replace(alone, episodes=5))
    config = json_of(run, "config")
    assert (config["name"], config["algorithm"]["beta"]) == ("bgpo-single", 0.3)
    assert (run / "train.csv").read_text().startswith(played)
    other = partial(continual, replace(alone, algorithm="bgpo"))
    refused(other, "name is bgpo-single there and bgpo here", "choose another")
    monkeypatch.chdir(run)
    assert continual(Arguments(resume=True)).startswith(f"{run} is finished, all 5 episodes")
    assert json_of(run, "summary")["changed"] == {"beta": 0.3}

    again = tmp_path / "again"
    with monkeypatch.context() as patch:  # encoders and demonstrations are the run's, too
        patch.delattr(experiment, "load_pretrained")
        continual(Arguments(out=again, config=run))
    assert (again / "config.json").read_bytes() == (run / "config.json").read_bytes()
    repeated, extended = ((path / "train.csv").read_text().split("\n") for path in (again, run))
    assert sorted(repeated) == sorted(extended)  # in which episodes played early are logged late
    fewer = Arguments(out=tmp_path / "fewer", config=run, tasks=TASKS[:2])
    refused(partial(continual, fewer), "has the tasks", "--bank")
    edit(run / "config.json", logged="ab")
    other = Arguments(out=tmp_path / "other", config=run)
    refused(partial(continual, other), "began with logged episodes", "--logged")


def test_the_directory_is_locked_from_the_encoders_to_the_figures(
    undrawn, tmp_path, monkeypatch, other_process
):
    refusals = []
    for name in ("load_pretrained", "draw"):
        function = getattr(experiment, name)

        def do(*args, function=function, **kwargs):
            refusals.append(other_process(tmp_path / "run").communicate()[1])
            return function(*args, **kwargs)

        monkeypatch.setattr(experiment, name, do)
    continual(Arguments(out=tmp_path / "run", episodes=2))
    assert ["is in use by another process" in refusal for refusal in refusals] == [True, True]
    assert not (tmp_path / "run" / "lock").exists()


def test_dashboards_get_evaluations_and_final_tests(tiniest, monkeypatch, tmp_path):
    run, started = tmp_path / "run", []

    def start(directory, *mode, **options):
        assert directory == run
        started.append(Recorder())
        return started[-1]

    monkeypatch.setattr(experiment, "wandb_logger", start)
    monkeypatch.setattr(experiment, "tensorboard_logger", start)
    monkeypatch.setattr("bgpo_trl.runs.dashboard.find_spec", lambda package: package)
    arguments = Arguments(out=run, wandb="offline", tensorboard=True)
    continual(arguments)
    trained = read_table(run / "final.csv").query("demonstrations == 'held-out'")
    means = {f"final/success/{task}": s.mean() for task, s in trained.groupby("task")["success"]}
    means["final/success_mean"] = trained["success"].mean()
    tested = sorted(set(read_table(run / "eval.csv")["episode"]))
    assert len(started) == 2
    for recorder in started:
        assert [step for _, step in recorder.metrics] == [*tested, 6]
        assert recorder.metrics[-1][0] == pytest.approx(means)
        assert recorder.closed

    (run / "summary.json").unlink()  # as if it had been killed when training was over
    continual(replace(arguments, tensorboard=False, resume=True))
    assert len(started) == 3
    assert [step for _, step in started[-1].metrics] == [6]

    for again in ({}, {"resume": True, "settings": ("--seeds", "4")}):
        with pytest.raises(ValueError, match="holds a run"):
            continual(replace(arguments, **again))
    assert len(started) == 3  # a run that is refused starts no logger


@pytest.mark.parametrize(("package", "value"), [("wandb", "offline"), ("tensorboard", True)])
def test_a_missing_dashboard_is_told_before_a_run_begins(package, value, monkeypatch, tmp_path):
    monkeypatch.setattr("bgpo_trl.runs.dashboard.find_spec", lambda package: None)
    with pytest.raises(ImportError, match=rf"pip install 'bgpo_trl\[{package}\]'"):
        continual(Arguments(out=tmp_path / "run", **{package: value}))
    assert not (tmp_path / "run").exists()


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
    for name in ("figures/gwr.png", "demonstrations/dataset.json", "encoders/probes.json"):
        assert (tmp_path / "run" / name).stat().st_size > 0
    played = [(row["seed"], int(row["episode"])) for row in rows(tmp_path / "run" / "train.csv")]
    assert sorted(played) == [(seed, n) for seed in "01" for n in range(1, 13)]


def test_a_run_that_was_interrupted_while_it_made_encoders_is_resumed(
    undrawn, tmp_path, monkeypatch, encoders, bank, refused
):
    monkeypatch.setattr(experiment, "make_pretrained", lambda *_, **__: (encoders, bank))
    monkeypatch.setattr(experiment, "verdict_in", lambda *_: "")
    (tmp_path / "demonstrations").mkdir()
    arguments = Arguments(out=tmp_path, resume=True, episodes=2)
    refused(lambda: continual(arguments), "beginning of new encoders", "add --train-encoders")
    continual(replace(arguments, train_encoders=True))
    assert (tmp_path / "summary.json").exists()


@pytest.mark.parametrize("named", ["encoders", "config"])
@pytest.mark.parametrize("unwritten", ["training.keep_inputs", "data.bank.DemonstrationBank.save"])
def test_a_run_that_was_killed_before_it_kept_what_is_named_is_resumed(
    undrawn, tmp_path, monkeypatch, encoders, named, unwritten
):
    run, files = tmp_path / "run", {name: tmp_path / name for name in ("encoders", "config")}
    save_representation(encoders, files["encoders"])
    continual(Arguments(out=files["config"], episodes=2))
    arguments = Arguments(out=run, episodes=2, **{named: files[named]})

    def kill(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(f"bgpo_trl.{unwritten}", kill)
        with pytest.raises(KeyboardInterrupt):
            continual(arguments)
    assert not (run / "checkpoint").exists()
    continual(replace(arguments, resume=True))
    assert (run / "summary.json").exists()
    assert own_weights(run).exists() and (run / "bank.safetensors").exists()


def test_new_encoders_are_trained_with_the_settings_of_a_file(
    undrawn, tmp_path, monkeypatch, encoders, bank
):
    trained = []

    def make(*_, config, folder, **__):
        trained.append(config)
        (folder / "probes.json").write_text('{"things_lost": 0.25}')
        return encoders, bank

    monkeypatch.setattr(experiment, "make_pretrained", make)
    (path := tmp_path / "mine.yaml").write_text("vae: {steps: 7}\ninverse: {largest_action: 2}")
    arguments = Arguments(out=tmp_path / "run", episodes=2, train_encoders=True)
    (tmp_path / "run" / "encoders").mkdir(parents=True)
    text = continual(replace(arguments, encoder_settings=path))
    assert re.search(r"its encoders:\nthings .* 0.25  at most 0.10   not good\n", text)
    usual = RepresentationConfig()
    vae, inverse = replace(usual.vae, steps=7), replace(usual.inverse, largest_action=2.0)
    assert trained == [replace(usual, vae=vae, inverse=inverse)]


def test_a_task_is_added_to_a_finished_run_and_reported(undrawn, tmp_path, encoders, bank):
    run = tmp_path / "run"
    continual(Arguments(out=run))
    of_encoders = {"encoder_id": encoders.identity, "scene": encoders.metadata["scene"]}
    further = replace(bank.for_tasks(TASKS[2:]), tasks=("lift_green",), **of_encoders)
    further.save(tmp_path / "further.safetensors")
    options = {"add_task": "lift_green", "bank": tmp_path / "further.safetensors"}
    command = Arguments(out=run, resume=True, episodes=16, **options)
    # The new demonstrations are copies of those of another task.
    with pytest.warns(match="confuse the new task with push_green_to_white"):
        printed = continual(command)
    assert "lift_green: nearest demonstration of the same task: 0% of the new" in printed
    tests = read_table(run / "final.csv")
    assert set(tests["task"]) == {*TASKS, "lift_green"}
    assert json_of(run, "config")["tasks"] == [*TASKS, "lift_green"]
    assert json_of(run, "config")["task_starts"][-1] > 6
    (run / "summary.json").unlink()  # as if it had been interrupted in its last tests
    assert "curve and figures" in continual(command)
    for again in (command, Arguments(out=run, resume=True)):
        assert "is finished, all 16 episodes" in continual(again)


def test_a_policy_of_the_ground_truth_needs_no_frames(tiniest, tmp_path):
    run, settings = tmp_path / "run", ("--algorithm.state", "state")
    continual(Arguments(algorithm="without-bonus", out=run, settings=settings))
    assert json_of(run, "config")["algorithm"]["state"] == "state"
    assert json_of(run, "summary")["episodes"] == 6
    figures = {path.name for path in (run / "figures").iterdir()}
    assert "success.png" in figures
    assert not figures & {"episodes.png", *(f"{task}.gif" for task in TASKS)}


def test_seen_tests_show_only_demonstrations_of_training(tiniest, tmp_path, monkeypatch):
    made = spied(measure, "Evaluator", monkeypatch)
    continual(Arguments(out=tmp_path / "run", settings=("--demonstrations", "1")))
    seen, held_out, *_ = (bank for (_, bank, *_), _ in made)
    assert seen.task.tolist() == [0, 1, 2]  # one demonstration of each task
    assert len(held_out.task) > 3


def test_a_run_says_what_it_reached_and_in_how_many_steps():
    """Of an archived run: equal to its rows, whose tests are as many for each seed."""
    run = read_run(RESULTS / "desk-learner" / "continual-bgpo")
    *lines, last = success_lines(run)
    tests = run.final[run.final["demonstrations"] == "held-out"]
    for line, task in zip([*lines, last], run.tasks, strict=True):
        rate, steps, shown = map(float, re.findall(r"([\d.]+)(?:%| steps|\))", line))
        found = tests[tests["task"] == task].groupby("seed")[["success", "steps"]].mean().mean()
        assert line.startswith(f"{task}: ")
        assert (rate, steps) == (round(100 * found["success"]), round(found["steps"], 1))
        assert shown == round(run.summary["demonstrated_steps"][task], 1)
    poor = run.final.assign(success=run.final["success"] * (run.final["task"] != run.tasks[1]))
    assert "seldom succeeds" in success_lines(replace(run, final=poor))[-1]
