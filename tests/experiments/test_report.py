"""Reports and comparisons of runs with success written by hand."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.comparison import Setting
from bgpo_trl.analysis.scores import forward_transfer
from bgpo_trl.analysis.tables import success_section
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.runs import results
from bgpo_trl.runs.results import read_run
from tests.analysis.runs import TASKS, write_run, write_training
from tests.helpers import cells, edit

STARTS = (0, 14, 26)
IN_SEQUENCE, FROM_START = "3 tasks, one after the other", "3 tasks, all from the start"
LEVELS = {"bgpo": [9, 8, 10], "dist-nll-demonstrations": [8, 10, 9], "bgpo-single": [6, 2, 9]}


def complete(run):
    """Adds what runs with experts leave: training, final tests, nodes and costs."""
    write_training(run, [[[0] * 10 + [1] * 3] * 3] * 3)
    found = {"nodes": [90, 89, 88], "groups": [3] * 3, "group_purity": [1.0, 0.985, 0.985]}
    steps = dict(zip(TASKS, (10.0, 20.0, 60.0), strict=True))
    edit(run / "summary.json", **found, demonstrated_steps=steps)
    rows = [
        f"{seed},{kind},{task},20,{success},{7 + seed},{1 - seed / 100}\n"
        for seed in range(3)
        for kind, success in (("seen", 0.5), ("held-out", 0.25))
        for task in TASKS
    ]
    head = "seed,demonstrations,task,episodes,success,steps,task_inference\n"
    (run / "final.csv").write_text(head + "".join(rows))
    (run / "cost.csv").write_text("tasks,steps,seconds,megabytes\n1,30,0.3,2\n3,60,0.9,9\n")


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The report on some algorithms in both settings, only to be read; BGPO is best."""
    folder = tmp_path_factory.mktemp("runs")
    for starts, of_maml in (((0, 0, 0), [5, 4, 5]), (STARTS, [2, 1, 2])):
        for name, levels in {**LEVELS, "maml-demonstrations": of_maml}.items():
            write_run(folder, name, levels, starts=starts)
    complete(folder / "continual-bgpo")
    report(ReportArguments((folder,)))
    return folder


def text_of(folder):
    return (folder / "tables.md").read_text()


def table_of(folder, title):
    """The table below a title, as lists of cells, by the first cell."""
    section = text_of(folder).split(f"## {title}\n")[1].split("\n## ")[0]
    return {row[0]: row[1:] for row in cells(section)[1:]}


def test_success_is_a_mean_over_seeds(reported):
    table = table_of(reported, IN_SEQUENCE)
    # 80, 90 and 100 % by seed: a standard error of 5.77, times 4.303.
    assert table["BGPO"][:4] == ["nothing", "3", "90.0 [65, 100]", "90.0 [65, 100], task 1"]
    assert table["BGPO"][4:7] == ["90.0"] * 3
    assert table["MAML + demonstrations"][:3] == ["label", "3", "16.7 [2, 31]"]
    from_start = table_of(reported, FROM_START)
    # From 0 to 0.45 in 2 episodes, which is 4 or 5 of ten by seed, to episode 32, 34 and 40.
    half, late = (4 + 4 + 5) / 30, 0.9
    area = (2 * half / 2 + 30 * half + 2 * (half + late) / 2 + 6 * late) / 40
    assert from_start["BGPO"][-1].startswith(f"{100 * area:.1f} [")


def test_what_an_algorithm_knows_of_tasks_is_shown(tmp_path):
    run = read_run(write_run(tmp_path, "bgpo", 9))
    told = {"nothing": False, "label, boundaries": True}
    runs = {
        text: replace(run, summary={"needs_label": needs, "needs_boundaries": needs})
        for text, needs in told.items()
    }
    section = success_section(Setting({**runs, "?": replace(run, summary={})}))
    head, *rows = section.table
    assert [row[head.index("knows of tasks")] for row in rows] == [*runs, "?"]


def test_differences_are_judged_by_their_intervals(reported):
    table = table_of(reported, f"Differences: {IN_SEQUENCE}")
    over_maml = table["BGPO against MAML + demonstrations"]
    by_hand = statistics.difference([0.9, 0.8, 1.0], [0.2, 0.1, 0.2])
    # 2 of 20 ways to deal three and three seeds.
    assert over_maml[:3] == [by_hand.estimate.points(), "above", "0.100"]
    wide = table["BGPO against Dist-NLL + demonstrations"]
    assert wide[0].startswith("+0.0 [-23, +23]")
    assert wide[1:3] == ["not decided", "1.000"]


def test_forgetting_and_transfer_equal_those_by_hand(reported):
    table = table_of(reported, f"Forgetting and transfer: {IN_SEQUENCE}")
    # After their phases, tasks 1 and 2 are at 40, 40 and 50 % by seed; all end at 90, 80, 100.
    changes = np.array([[0.5, 0.5, 0], [0.4, 0.4, 0], [0.5, 0.5, 0]])
    runs = [read_run(reported / f"{setting}-bgpo") for setting in ("continual", "concurrent")]
    assert table["BGPO"] == [
        statistics.mean(-changes.mean(1)).points(),
        forward_transfer(*runs).points(),
    ]


def test_groups_and_costs_of_a_run_are_listed(reported):
    never = "not reached (3 of 3 seeds never)"
    assert table_of(reported, f"GWR-B, by seed: {IN_SEQUENCE}") == {
        "BGPO": ["3 3 3", "100 98.5 98.5", "99.00", "100 99 98", "90 89 88"]
    }
    assert table_of(reported, f"Cost: {IN_SEQUENCE}") == {
        "BGPO": ["0.0", "10.0 ms, 2 MB", "15.0 ms, 9 MB"]
    }
    assert table_of(reported, f"Own episodes to 50 %: {IN_SEQUENCE}")["BGPO"][0] == never
    by_task = table_of(reported, f"BGPO: {IN_SEQUENCE}")
    assert list(by_task) == [*TASKS, "all"]
    # Successes take 5, 6, ... steps: 9, 8 and 10 of them by seed.
    steps = np.mean([np.mean([5 + n for n in range(seed)]) for seed in LEVELS["bgpo"]])
    learned = ["90.0 [65, 100]", "90 80 100"]
    steps = [f"{steps:.1f}", "8.0", "10.0"]
    assert by_task[TASKS[0]] == [*learned, "50.0", "25.0", "99.00", *steps]
    assert by_task["all"][:2] == learned
    assert by_task["all"][-3:] == [*steps[:2], "30.0"]
    in_setting = table_of(reported, IN_SEQUENCE)
    assert in_setting["BGPO"][7:9] == [steps[0], "30.0"]
    assert in_setting["MAML + demonstrations"][8] == "-"


def test_figures_are_beside_the_tables_and_the_report_on_an_archive_is_the_same(reported, tmp_path):
    kinds = ("continual-3", "continual-3-steps", "continual-3-matrix")
    figures = {f"{kind}.png" for kind in (*kinds, "concurrent-3", "concurrent-3-steps")}
    assert {path.name for path in reported.glob("*.png")} == figures
    report(ReportArguments((reported,), archive=tmp_path / "archive"))
    report(ReportArguments((tmp_path / "archive",), out=tmp_path / "again"))
    assert text_of(tmp_path / "archive") == text_of(tmp_path / "again") == text_of(reported)
    for name in figures:
        assert f"]({name})" in text_of(reported)
        assert (tmp_path / "again" / name).read_bytes() == (reported / name).read_bytes()


def test_each_file_of_a_run_is_read_once(reported, tmp_path, monkeypatch):
    counts, read = Counter(), results.read_table
    monkeypatch.setattr(results, "read_table", lambda path: counts.update([path]) or read(path))
    report(ReportArguments((reported,), out=tmp_path))
    assert counts == Counter(reported.glob("*/*.csv"))


def split(run, folder):
    """Write a run of three seeds as three runs, whose folders are not in the order of the seeds."""
    for seed in range(3):
        part = shutil.copytree(run, folder / run.name / f"part-{2 - seed}")
        for name in ("eval.csv", "train.csv", "final.csv"):
            head, *rows = (run / name).read_text().splitlines(keepends=True)
            place = head.split(",").index("seed")
            kept = [row for row in rows if row.split(",")[place] == str(seed)]
            (part / name).write_text("".join([head, *kept]))
        edit(part / "config.json", seeds=[seed])
        summary = json.loads((run / "summary.json").read_text())
        lists = {name: [summary[name][seed]] for name in ("nodes", "groups", "group_purity")}
        edit(part / "summary.json", **lists)
        costs = "tasks,steps,seconds,megabytes\n1,30,0.1,0.6667\n3,60,0.3,3\n"
        (part / "cost.csv").write_text(costs)


def test_runs_that_differ_in_their_seeds_alone_are_reported_as_one(reported, tmp_path):
    split(reported / "continual-bgpo", tmp_path)
    alone = report(ReportArguments((reported / "continual-bgpo",), out=tmp_path / "whole"))
    archive = tmp_path / "archive"
    parts = tmp_path / "continual-bgpo"
    assert report(ReportArguments((parts,), archive=archive)) == alone
    assert report(ReportArguments((archive,), out=tmp_path / "again")) == alone


@pytest.mark.parametrize(
    ("tasks", "seeds", "title", "mean"),  # without intervals, as single and equal scores have none
    [
        (("juggle",), 1, "1 task, all from the start", "90.0"),
        ("abcdefgh", 3, "8 tasks, one after the other", "90.0"),
    ],
)
def test_any_number_of_tasks_and_seeds_is_reported(tasks, seeds, title, mean, tmp_path):
    starts = range(0, 32, 32 // len(tasks))
    for name, level in {"mine": 9, "bgpo": 2}.items():
        write_run(tmp_path, name, [level] * seeds, tasks=tasks, starts=starts)
    report(ReportArguments((tmp_path,)))
    assert "nan" not in text_of(tmp_path)
    found = table_of(tmp_path, title)["mine"]
    assert found[1:3] == [str(seeds), mean]
    assert found[4 : 4 + len(tasks)] == ["90.0"] * len(tasks)
    if seeds == 1:
        (row,) = table_of(tmp_path, f"Differences: {title}").values()
        assert row[:3] == ["-70.0", "not decided", "-"]


def test_notes_say_what_is_left_out_without_the_folders_of_this_machine(tmp_path):
    run = write_run(tmp_path, "bgpo", 9, starts=(0, 1, 20))
    edit(run / "summary.json", command=f"python x.py --out {tmp_path}/bgpo --seeds 0 1")
    (write_run(tmp_path, "oracle", 5) / "eval.csv").unlink()
    printed = report(ReportArguments((tmp_path,)))
    assert str(tmp_path) not in printed and printed == text_of(tmp_path)
    assert "`python x.py --out .../bgpo --seeds 0 1`" in printed
    assert ".../concurrent-oracle holds no test episode" in printed
    assert "there is no evaluation in the 2 episodes before episode 1" in printed


def test_other_conditions_are_refused_before_anything_is_written(tmp_path, refused):
    write_run(tmp_path, "bgpo", 9)
    write_run(tmp_path, "oracle", 5, held_out="test")
    for archive in (None, tmp_path / "archive"):
        asked = ReportArguments((tmp_path,), archive=archive)
        refused(partial(report, asked), "differ in held_out (validation and test)", "only runs")


def test_runs_whose_folders_have_one_name_are_reported_apart(tmp_path, refused):
    for folder, level in (("old", 9), ("new", 5)):
        write_run(tmp_path / folder, "bgpo", level)
    report(ReportArguments((tmp_path / "old", tmp_path / "new"), out=tmp_path))
    rows = table_of(tmp_path, "3 tasks, all from the start")
    assert {name: row[2] for name, row in rows.items() if "BGPO" in name} == {
        "BGPO (old/concurrent-bgpo)": "90.0",
        "BGPO (new/concurrent-bgpo)": "50.0",
    }
    for number, (name, beta) in enumerate(product("mn", (0.1, 0.1))):
        settings = {"max_steps": 50, "beta": 0.5 if name == "n" else beta}
        one = write_run(tmp_path / "seeds", "bgpo", [9], directory=f"{name}{number % 2}")
        edit(one / "config.json", seeds=[number % 2], algorithm=settings)
        rows = (one / "eval.csv").read_text().replace("bgpo,0,", f"bgpo,{number % 2},")
        (one / "eval.csv").write_text(rows)
    report(ReportArguments((tmp_path / "seeds",)))
    assert {*table_of(tmp_path / "seeds", "3 tasks, all from the start")} >= {
        "BGPO (m0)",
        "BGPO (n0)",
    }
    twice = ReportArguments((tmp_path / "old", tmp_path / "old"), out=tmp_path)
    refused(partial(report, twice), "concurrent-bgpo is given twice", "name each run once")


def test_only_finished_runs_are_archived_by_their_own_names(tmp_path, monkeypatch):
    run = write_run(tmp_path / "runs", "bgpo", 9)
    (write_run(tmp_path / "runs", "oracle", 5) / "eval.csv").unlink()
    report(ReportArguments((tmp_path / "runs",), archive=tmp_path / "archive"))
    assert [path.name for path in (tmp_path / "archive").glob("*/")] == [run.name]
    monkeypatch.chdir(run)
    report(ReportArguments((Path(),), archive=tmp_path / "alone"))
    assert [path.name for path in (tmp_path / "alone").glob("*/")] == [run.name]
