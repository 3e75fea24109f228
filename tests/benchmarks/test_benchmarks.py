"""The benchmarks' command lines: what they run, what they leave behind, and what they refuse."""

import csv
import dataclasses
import hashlib
import json
import math
import os
import re
import runpy
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, get_args, get_type_hints

import pytest
import tyro

from benchmarks import concurrent_tasks, continual, ladder, summary
from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.configs import PRESETS, DDPGConfig
from bgpo_trl.experiments import measure
from bgpo_trl.experiments import run as experiment
from bgpo_trl.experiments.arguments import Arguments, run_config
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.runs.logger import EVAL_COLUMNS
from bgpo_trl.runs.results import read_rows
from suites import nico

ROOT = Path(__file__).parents[2]
TASKS = nico.PAPER_TASKS


def files(folder):
    found = [path for path in folder.rglob("*") if path.is_file()]
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


def test_a_preset_is_taken_as_it_is():
    for name, preset in PRESETS.items():
        assert run_config(Arguments(preset=name)) == preset


@pytest.mark.parametrize("name", ALGORITHMS)
def test_another_algorithm_changes_nothing_else(name):
    for preset, config in PRESETS.items():
        arguments = Arguments(algorithm=name, preset=preset)
        entry = ALGORITHMS[name]
        expected = replace(config, name=name, algorithm=entry.config)
        assert run_config(arguments) == expected
        published = name.endswith("-paper")
        assert (entry.config.rl == DDPGConfig()) is not published  # else the same learner for all


def test_the_command_line_knows_every_algorithm():
    choices = get_type_hints(Arguments)
    assert get_args(choices["algorithm"]) == tuple(ALGORITHMS)
    assert get_args(choices["rl"]) == tuple(RL)


@pytest.mark.parametrize("rl", RL)
@pytest.mark.parametrize("name", ["bgpo", "oracle", "ddpg"])
def test_another_rl_algorithm_changes_nothing_else(name, rl):
    plain = run_config(Arguments(algorithm=name))
    config = run_config(Arguments(algorithm=name, rl=rl))
    assert config == replace(plain, algorithm=replace(plain.algorithm, rl=RL[rl].config))
    assert dataclasses.asdict(config)["algorithm"]["rl"]["name"] == rl


def test_the_ladder_takes_the_settings_of_each_rl_algorithm():
    for rl, entry in RL.items():
        line = ["--rungs", "a", "--out", "here", rl, "--learning-rate", "0.5"]
        arguments = tyro.cli(Annotated[ladder.Arguments, tyro.conf.OmitArgPrefixes], args=line)
        assert arguments.rl == replace(entry.config, learning_rate=0.5)
        assert (arguments.rungs, arguments.out) == (("a",), Path("here"))


@pytest.mark.parametrize("script", ["continual", "concurrent_tasks", "ablation"])
def test_a_run_with_another_rl_algorithm_has_a_name_of_its_own(tmp_path, monkeypatch, script):
    monkeypatch.chdir(tmp_path)
    name = {"ablation": "ablation-gwr", "concurrent_tasks": "concurrent-bgpo"}.get(
        script, f"{script}-bgpo"
    )
    taken = tmp_path / "runs" / f"{name}-sac-quick"
    taken.mkdir(parents=True)
    (taken / "config.json").touch()
    line = ["--rl", "sac", *(["--variant", "gwr"] if script == "ablation" else [])]
    told = ended_with(monkeypatch, f"{script}.py", *line)
    assert told.startswith(f"error: {taken.relative_to(tmp_path)} holds a run: --resume")


@pytest.mark.parametrize("preset", PRESETS)
def test_tasks_of_every_preset_start_when_the_paper_has_them_start(preset):
    config = PRESETS[preset]
    shares = [start / config.episodes for start in config.task_starts]
    assert shares == pytest.approx([0, 7_000 / 20_000, 13_000 / 20_000], abs=0.02)


@pytest.mark.parametrize(
    ("preset", "episodes", "starts", "eval_every"),
    [
        ("paper", 10_000, (0, 3_500, 6_500), 1),
        ("quick", 2_400, (0, 840, 1_560), 60),
        ("quick", 20, (0, 7, 13), 20),  # tested once at least
    ],
)
def test_another_length_keeps_the_proportions(preset, episodes, starts, eval_every):
    config = run_config(Arguments(preset=preset, episodes=episodes))
    assert (config.episodes, config.task_starts) == (episodes, starts)
    assert config.eval_every == eval_every
    assert config == replace(
        PRESETS[preset], episodes=episodes, task_starts=starts, eval_every=eval_every
    )


def test_other_seeds_change_nothing_else():
    config = run_config(Arguments(preset="desk", seeds=(7, 9)))
    assert config == replace(PRESETS["desk"], seeds=(7, 9))


@pytest.mark.parametrize(
    "arguments", [{"episodes": 0}, {"episodes": -3}, {"seeds": ()}, {"seeds": (2, 2)}]
)
def test_lengths_and_seeds_that_cannot_be_are_refused(arguments):
    with pytest.raises(ValueError, match=r"must be at least 1|needs seeds"):
        run_config(Arguments(**arguments))


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

    before = files(run_directory)
    with pytest.raises(ValueError, match="holds a run: --resume continues it, --out names another"):
        continual.main(Arguments(out=run_directory))
    assert files(run_directory) == before


def test_a_finished_run_only_says_so_until_it_is_made_longer(
    undrawn, tmp_path, monkeypatch, capsys
):
    run = tmp_path / "run"
    arguments = Arguments(out=run)
    continual.main(arguments)
    before, played = files(run), (run / "train.csv").read_text()
    again = replace(arguments, resume=True)
    with monkeypatch.context() as patch:
        for name in ("load_pretrained", "make_pretrained", "Trainer", "measure", "draw"):
            patch.delattr(experiment, name)
        for same in (again, replace(again, episodes=6), replace(again, train_encoders=True)):
            capsys.readouterr()
            continual.main(same)
            told = f"{run} is finished, all 6 episodes: --episodes makes it longer\n"
            assert capsys.readouterr() == (told, "")
    assert files(run) == before

    others = [{"episodes": 5}, {"seeds": (3,)}, {"eval_every": 3}, {"episodes": 9, "eval_every": 3}]
    for other in others:
        with pytest.raises(ValueError, match="holds a run with other settings"):
            continual.main(replace(again, **other))
    with pytest.raises(ValueError, match=r"with other settings .*task_starts is \[0, 2, 4\] there"):
        concurrent_tasks.main(replace(again, episodes=9))
    assert files(run) == before

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


def test_a_run_that_was_interrupted_before_its_training_is_resumed(
    undrawn, tmp_path, monkeypatch, encoders, bank
):
    monkeypatch.setattr(experiment, "make_pretrained", lambda *_, **__: (encoders, bank))
    (tmp_path / "demonstrations").mkdir()
    arguments = Arguments(out=tmp_path, resume=True, episodes=2)
    with pytest.raises(ValueError, match="holds no run to resume"):
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
            assert f"in use by process {os.getpid()} on" in other.communicate()[1]
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
    rows = [read_rows(run / name) for name in ("train.csv", "eval.csv")]
    assert events == ["row"] * sum(map(len, rows)) + [*shown, "shutdown"]
    for task in TASKS:
        assert (run / "figures" / f"{task}.gif").read_bytes().startswith(b"GIF89a")

    events.clear()
    (run / "summary.json").unlink()  # as if it had been killed when training was over
    continual.main(replace(arguments, resume=True))
    assert events == [*shown, "shutdown"]


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
        rows = read_rows(run / file)
        assert {row["algorithm"] for row in rows} == {name}
        assert {row["task"] for row in rows} == set(TASKS)

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
        assert ("group" in read_rows(run / "gwr.csv")[0]) == with_groups
    assert ("GWR-B" in printed) == ("task inference" in printed) == with_gwr
    rows = read_rows(run / "final.csv")
    assert len(rows) == 2 * 2 * 3
    assert all((row["task_inference"] != "") == with_gwr for row in rows)
    summed_up = summary.describe(run)
    assert ("GWR-B nodes: [" in summed_up) == with_gwr
    assert ("Groups: [" in summed_up) == with_groups
    assert "Own episodes to 50 %, relative to grasp_glass: push" in summed_up
    table = [line.split("|") for line in summed_up.splitlines() if line.startswith("|")]
    assert [row[1].strip() for row in table[2:]] == [*TASKS, "all"]
    assert all((row[-2].strip() != "") == with_gwr for row in table[2:])
    for task, row in zip(TASKS, table[2:], strict=False):
        shares = [float(r["success"]) for r in rows if r["task"] == task]
        for cell, of_kind in zip(row[6:8], (shares[:2], shares[2:]), strict=True):
            assert float(cell) == pytest.approx(100 * sum(of_kind) / 2, abs=0.05)


def test_concurrent_presents_all_tasks_from_the_start(tiny, tmp_path, capsys, monkeypatch):
    run, asked, test = tmp_path / "run", [], measure._final_tests
    monkeypatch.setattr(measure, "_final_tests", lambda *a, **b: asked.append(b) or test(*a, **b))
    concurrent_tasks.main(Arguments(out=run))
    assert asked == [{"episodes": 20}]  # of which `tiny` leaves two
    assert json.loads((run / "config.json").read_text())["task_starts"] == [0, 0, 0]
    assert {row["task"] for row in read_rows(run / "eval.csv")} == set(TASKS)

    rows = read_rows(run / "final.csv")
    assert sorted((int(r["seed"]), r["demonstrations"], r["task"]) for r in rows) == sorted(
        (seed, kind, task) for seed in (3, 8) for kind in ("seen", "held-out") for task in TASKS
    )
    for row in rows:
        assert row["episodes"] == "2"
        assert 2 * float(row["success"]) in range(3)
        assert 0 <= float(row["task_inference"]) <= 1
    told = json.loads((run / "summary.json").read_text())
    assert re.fullmatch(r"|[0-9a-f]{7,}(-dirty)?", told["commit"])
    assert len(told["nodes"]) == 2
    assert told["random_success"] == pytest.approx(dict(zip(TASKS, [0.1, 0.2, 0.3], strict=True)))
    nodes = read_rows(run / "gwr.csv")
    assert len(nodes) == told["nodes"][0]
    assert {node["task"] for node in nodes} <= {"-1", "0", "1", "2"}
    assert {int(node["group"]) for node in nodes} <= set(range(told["groups"][0]))
    assert [len(node) for node in nodes] == [34] * len(nodes)
    assert (run / "figures" / "episodes.png").read_bytes().startswith(b"\x89PNG")

    capsys.readouterr()
    summary.main(summary.Arguments((run,)))
    printed = capsys.readouterr().out
    late = summary.summarize(run / "eval.csv")
    for task in TASKS:
        assert f"| {task} | {100 * late[task]:.1f} |" in printed
    for name in ("success.png", "groups.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")


def test_the_best_part_of_a_run_is_the_best_mean_over_a_tenth(tmp_path):
    def outcomes(success):
        return [success], [success], [success]

    successes = {100 * (i + 1): outcomes(float(8 <= i < 12)) for i in range(40)}
    write_tests(tmp_path / "eval.csv", successes)  # a tenth is 400 episodes, four tests
    assert set(summary.best(tmp_path / "eval.csv").values()) == {1.0}
    successes = {100 * (i + 1): outcomes(float(8 <= i < 10)) for i in range(40)}
    write_tests(tmp_path / "eval.csv", successes)
    assert set(summary.best(tmp_path / "eval.csv").values()) == {0.5}


def test_a_run_that_is_not_finished_cannot_be_summed_up(tmp_path):
    write_tests(tmp_path / "eval.csv", {100: ([1], [1], [0])})
    with pytest.raises(ValueError, match=r"config\.json is missing: let the run in .* finish"):
        summary.main(summary.Arguments((tmp_path,)))
    settings = {"episodes": 200, "eval_every": 100, "task_starts": [0, 0, 0]}
    (tmp_path / "config.json").write_text(json.dumps(settings))
    with pytest.raises(ValueError, match=r"has tests until episode 100 of 200: let the run finish"):
        summary.main(summary.Arguments((tmp_path,)))
    with pytest.raises(ValueError, match="name the directory of a run"):
        summary.main(summary.Arguments(()))


def test_the_ladder_has_a_row_and_a_run_for_each_rung(tiny, tmp_path, capsys):
    ddpg = DDPGConfig(hidden_sizes=(7,), batch_size=16, warmup_steps=8, replay_size=200)
    arguments = ladder.Arguments(episodes=2, seeds=(1,), out=tmp_path, rl=ddpg)
    ladder.main(arguments)
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    assert lines[0] == "| rung | " + " | ".join([*TASKS, "overall", "episodes to 80 %"]) + " |"
    assert [line[:5] for line in lines[2:]] == ["| (a)", "| (b)", "| (c)", "| (d)"]
    assert all(re.search(r"\| (\d+|not reached) \|$", line) for line in lines[2:])
    seen = {}
    for rung in "abcd":
        config = json.loads((tmp_path / rung / "config.json").read_text())
        learner = load_checkpoint(tmp_path / rung / "checkpoint")["algorithm"]
        inputs = set(learner["replay"]["rows"]) - {"action", "next", "group"}
        seen[rung] = (config["algorithm"]["state"], inputs, "gwr" in learner)
        assert (config["task_starts"], config["eval_every"]) == ([0, 0, 0], 2)
        assert config["algorithm"]["rl"]["hidden_sizes"] == [7]
        assert (tmp_path / rung / "figures" / "success.png").exists()
        train = read_rows(tmp_path / rung / "train.csv")
        assert {row["algorithm"] for row in train} == {config["name"]} == {f"rung {rung}"}
        assert all((float(row["intrinsic_return"]) > 0) == (rung in "cd") for row in train)
    assert seen == {
        "a": ("state", {"state", "context"}, False),
        "b": ("latent", {"latent", "context"}, False),
        "c": ("latent", {"latent", "context"}, False),
        "d": ("latent", {"latent", "context"}, True),
    }

    before = files(tmp_path)
    ladder.main(replace(arguments, resume=True))
    assert files(tmp_path) == before
    assert capsys.readouterr().out == printed
    with pytest.raises(ValueError, match="already holds a run"):
        ladder.main(arguments)


def write_tests(path, successes):
    """Writes an eval.csv from successes by episode and task."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, EVAL_COLUMNS)
        writer.writeheader()
        for episode, by_task in successes.items():
            for task, outcomes in zip(TASKS, by_task, strict=True):
                for seed, success in enumerate(outcomes):
                    row = {"seed": seed, "episode": episode, "task": task, "success": success}
                    writer.writerow(row)


def test_a_rung_is_summed_up_by_the_last_tenth_and_the_first_80_percent(tmp_path):
    write_tests(
        tmp_path / "eval.csv",
        {
            1_600: ([0, 0], [1, 1], [0, 1]),
            1_700: ([1, 1], [1, 1], [1, 1]),  # by itself, it would be reached
            1_800: ([1, 1], [1, 1], [1, 0]),  # not among the last tenth
            1_900: ([1, 1], [0, 1], [0, 1]),  # of the last three, 15 of 18
            2_000: ([1, 0], [0, 0], [0, 0]),
        },
    )
    assert summary.summarize(tmp_path / "eval.csv") == pytest.approx(
        {
            "grasp_glass": 3 / 4,
            "push_green_to_glass": 1 / 4,
            "push_green_to_white": 1 / 4,
            "overall": 5 / 12,
            "episodes to 80 %": 1_900,
        }
    )


def test_a_summary_says_how_fast_each_task_was_learned(tmp_path):
    write_tests(tmp_path / "eval.csv", {100: ([1, 1], [1, 1], [0, 0])})
    final = ["seed,demonstrations,task,success,task_inference"]
    final += [f"0,{kind},{task},0.5," for kind in ("seen", "held-out") for task in TASKS]
    (tmp_path / "final.csv").write_text("\n".join(final) + "\n")
    told = {"commit": "c", "command": "python x", "nodes": [7, 8]}
    told |= {"groups": [3, 4], "group_purity": [1.0, 0.985]}
    (tmp_path / "summary.json").write_text(json.dumps(told))
    (tmp_path / "config.json").write_text("{}")
    # The last ten of 20, 30 and 20 episodes succeed; of the other seed, task 3 fails throughout.
    lengths = [(20, 10), (30, 10), (20, 10)], [(40, 10), (20, 10), (20, 0)]
    train, episode = ["seed,episode,task,success"], 0
    for seed, tasks in enumerate(lengths):
        for task, (length, won) in zip(TASKS, tasks, strict=True):
            for number in range(length):
                episode += 1
                train.append(f"{seed},{episode},{task},{int(number >= length - won)}")
    (tmp_path / "train.csv").write_text("\n".join(train) + "\n")
    lines = summary.describe(tmp_path).splitlines()
    cells = [line.split("|")[5].strip() for line in lines[2:6]]
    assert cells == ["30", "25", "not reached (1 of 2 seeds never)", ""]
    assert lines[7].startswith(
        "Episodes to 80 %: not reached. GWR-B nodes: [7, 8]. "
        "Groups: [3, 4], 100.0 98.5 % pure on held-out demonstrations. Commit c: "
    )
    # 1.5 and 0.5 times; 1 time and never.
    assert lines[8] == (
        "Own episodes to 50 %, relative to grasp_glass: "
        "push_green_to_glass 1.00, push_green_to_white not reached."
    )


def test_a_rung_that_never_gets_there(tmp_path):
    write_tests(tmp_path / "eval.csv", {100: ([1], [1], [0])})
    table = summary.summarize(tmp_path / "eval.csv")
    assert table.pop("episodes to 80 %") == math.inf
    assert table["overall"] == pytest.approx(2 / 3)


def ended_with(monkeypatch, script, *arguments):
    """Runs a script in this process; returns what it hands to the shell."""
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "benchmarks" / script), run_name="__main__")
    return ended.value.code


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--preset", "smoke", "--out", "here"), "error: here holds a run: --resume continues it"),
        (("--episodes", "0"), "error: episodes must be at least 1, got 0"),
        (("--algorithm", "maml", "--rl", "td3"), "error: MAML is defined over DDPG, not 'td3'"),
        (("--preset", "smoke", "--out", "file"), "error: cannot make the folder file ("),
    ],
)
def test_mistakes_of_a_person_are_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "config.json").write_text("{}")
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path)
    told = ended_with(monkeypatch, "continual.py", *arguments)
    assert told.startswith(message)
    assert "\n" not in told
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("script", ["continual.py", "ladder.py"])
@pytest.mark.parametrize("wrong", [("--presett", "quick"), ("--episodes", "many")])
def test_a_wrong_flag_is_named_and_nothing_done(tmp_path, monkeypatch, capsys, script, wrong):
    monkeypatch.chdir(tmp_path)
    assert ended_with(monkeypatch, script, *wrong) == 2
    assert wrong[0] in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_unknown_preset_is_answered_with_those_there_are(monkeypatch, capsys):
    assert ended_with(monkeypatch, "continual.py", "--preset", "huge") == 2
    told = capsys.readouterr().err
    assert all(preset in told for preset in PRESETS)


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
    assert process.returncode == 1
    assert load_checkpoint(tmp_path / "run" / "checkpoint")["evaluated"] < 2

    result = subprocess.run([*command, "--resume"], capture_output=True, **options)
    assert result.returncode == 0, result.stderr
    told = "curve and figures: run; in numbers: python benchmarks/summary.py run\n"
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
