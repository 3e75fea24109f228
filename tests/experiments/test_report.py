"""Reports and comparisons of runs with success written by hand."""

import os
from pathlib import Path

import numpy as np
import pytest

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.analysis import statistics
from bgpo_trl.analysis.comparison import NAMES, Setting, read_run
from bgpo_trl.analysis.scores import forward_transfer, since_best_unchanged
from bgpo_trl.analysis.tables import success_table
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.runs.cost import Cost, write_costs
from tests.analysis.runs import TASKS, edit, make_run, write_run, write_training
from tests.helpers import cells, contents

STARTS = (0, 14, 26)
ONE_AFTER_THE_OTHER = "3 tasks, one after the other"


def complete(run, seeds, tasks=TASKS):
    """Adds what runs with experts leave: training, final tests, nodes and costs."""
    seeds, tasks = range(seeds), tuple(tasks)
    turns = 40 // len(tasks)
    write_training(run, [[[0] * (turns - 3) + [1] * 3] * len(tasks) for _ in seeds], tasks)
    found = {"nodes": [90 - seed for seed in seeds], "groups": [3] * len(seeds)}
    edit(run / "summary.json", **found, group_purity=[1.0, *[0.985] * (len(seeds) - 1)])
    rows = ["seed,demonstrations,task,episodes,success,task_inference"]
    rows += [
        f"{seed},{kind},{task},20,{success},{1 - seed / 100}"
        for seed in seeds
        for kind, success in (("seen", 0.5), ("held-out", 0.25))
        for task in tasks
    ]
    (run / "final.csv").write_text("\n".join(rows) + "\n")
    rng = np.random.default_rng(0)
    nodes = ["task,group," + ",".join(f"w{i}" for i in range(4))]
    nodes += [f"{i % 3},{i % 2}," + ",".join(map(str, rng.random(4))) for i in range(9)]
    (run / "gwr.csv").write_text("\n".join(nodes) + "\n")
    write_costs(run / "cost.csv", {1: Cost(10, 0.1, 2.0), 3: Cost(20, 0.3, 9.0)})


def write_runs(folder):
    """A small set: some algorithms in both settings; BGPO is best."""
    levels = {"bgpo": [9, 8, 10], "dist-nll-demonstrations": [8, 10, 9]}
    levels |= {"maml-demonstrations": [5, 4, 5], "bgpo-single": [6, 2, 9]}
    for name, of_seeds in levels.items():
        write_run(folder, name, of_seeds)
    levels["maml-demonstrations"] = [2, 1, 2]
    for name, of_seeds in levels.items():
        run = write_run(folder, name, of_seeds, starts=STARTS)
        if name == "bgpo":
            complete(run, seeds=3)
    return folder


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The report on those runs, made once: only to be read."""
    folder = write_runs(tmp_path_factory.mktemp("runs"))
    report(ReportArguments((folder,)))
    return folder


def rows_of(text, title):
    """The table below a title, as lists of cells, by the first cell."""
    section = text.split(f"## {title}\n")[1].split("\n## ")[0]
    return {row[0]: row[1:] for row in cells(section)[1:]}


def text_of(folder):
    return (folder / "tables.md").read_text()


def test_success_is_a_mean_over_seeds(reported):
    table = rows_of(text_of(reported), ONE_AFTER_THE_OTHER)
    # 80, 90 and 100 % by seed: a standard error of 5.77, times 4.303.
    assert table["BGPO"][:4] == ["nothing", "3", "90.0 [65, 100]", "90.0 [65, 100], task 1"]
    assert table["BGPO"][4:7] == ["90.0"] * 3
    assert table["MAML + demonstrations"][:3] == ["label", "3", "16.7 [2, 31]"]
    from_start = rows_of(text_of(reported), "3 tasks, all from the start")
    # Four tests at 90 % end at 34, 36, ..., 40: the mean of three is there at 38.
    assert from_start["BGPO"][-1] == "38"
    assert from_start["MAML + demonstrations"][-1] == "not reached"
    # From 0 to 0.45 in 2 episodes, which is 4 or 5 of ten by seed, to episode 32, 34 and 40.
    half, late = (4 + 4 + 5) / 30, 0.9
    area = (2 * half / 2 + 30 * half + 2 * (half + late) / 2 + 6 * late) / 40
    assert from_start["BGPO"][-2].startswith(f"{100 * area:.1f} [")


@pytest.mark.parametrize(
    ("summary", "shown"),
    [
        ({"needs_label": False, "needs_boundaries": False}, "nothing"),
        ({"needs_label": True, "needs_boundaries": True}, "label, boundaries"),
        ({}, "?"),
    ],
)
def test_what_an_algorithm_knows_of_tasks_is_shown(summary, shown):
    head, row = success_table(Setting({"a run": make_run(**summary)}))
    assert dict(zip(head, row, strict=True))["knows of tasks"] == shown


def test_differences_are_judged_by_their_intervals(reported):
    table = rows_of(text_of(reported), f"Differences: {ONE_AFTER_THE_OTHER}")
    assert list(table) == [
        "BGPO against Dist-NLL + demonstrations",
        "BGPO against MAML + demonstrations",
        "BGPO against BGPO, one policy",
    ]
    over_maml = table["BGPO against MAML + demonstrations"]
    by_hand = statistics.difference([0.9, 0.8, 1.0], [0.2, 0.1, 0.2])
    assert over_maml[:2] == [by_hand.estimate.points(), "above"]
    assert over_maml[2] == "0.100"  # 2 of 20 ways to deal three and three seeds
    assert over_maml[3] == "0.300"  # three rows
    wide = table["BGPO against Dist-NLL + demonstrations"]
    assert wide[0].startswith("+0.0 [-23, +23]")
    assert wide[1].startswith("not decided (about ") and wide[2:4] == ["1.000", "1.000"]


def test_claims_of_the_runs_that_exist_are_listed(reported):
    text = text_of(reported)
    title = "The paper's claims, 3 tasks"
    lines = [line for line in text.split(f"## {title}")[1].splitlines() if line[:2] == "| "]
    found = {tuple(line.strip("| ").split(" | ")[i] for i in (0, 2)): line for line in lines[2:]}
    # Two rivals, two settings and two measures; two leads.
    assert len(found) == 10
    assert "reproduced" in found["BGPO above MAML, one after the other", "success"]
    lead = found["the lead over MAML is larger one after the other", "success"]
    four = [[0.9, 0.8, 1], [0.2, 0.1, 0.2], [0.9, 0.8, 1], [0.5, 0.4, 0.5]]
    assert statistics.difference(*four).estimate.points() in lead
    assert "further claims need runs that are not here" in text
    assert text.count("missing") == 0


def test_forgetting_and_transfer_equal_those_by_hand(reported):
    table = rows_of(text_of(reported), f"Forgetting and transfer: {ONE_AFTER_THE_OTHER}")
    # After their phases, tasks 1 and 2 are at 40, 40 and 50 % by seed; all end at 90, 80, 100.
    changes = np.array([[0.5, 0.5, 0], [0.4, 0.4, 0], [0.5, 0.5, 0]])
    runs = [read_run(reported / f"{setting}-bgpo") for setting in ("continual", "concurrent")]
    assert table["BGPO"] == [
        statistics.mean(-changes.mean(1)).points(),
        "+0.0 [+0, +0]",
        f"{100 * since_best_unchanged(runs[0]).mean():+.1f}",
        statistics.mean(changes[:, :2].mean(1)).points(),
        forward_transfer(*runs).points(),
    ]


def test_groups_nodes_and_costs_of_a_run_are_listed(reported):
    text = text_of(reported)
    groups = rows_of(text, f"GWR-B, by seed: {ONE_AFTER_THE_OTHER}")
    assert groups == {"BGPO": ["3 3 3", "100 98.5 98.5", "99.00", "100 99 98", "90 89 88"]}
    assert rows_of(text, f"Cost: {ONE_AFTER_THE_OTHER}") == {
        "BGPO": ["0.0", "10.0 ms, 2 MB", "15.0 ms, 9 MB"]
    }
    own = rows_of(text, f"Own episodes to 50 %: {ONE_AFTER_THE_OTHER}")
    assert own["BGPO"][0] == "not reached (3 of 3 seeds never)"
    nodes = np.loadtxt(reported / "continual-bgpo" / "gwr.csv", delimiter=",", skiprows=1)
    means = [nodes[nodes[:, 0] == task, 2:].mean(0) for task in range(3)]
    apart = rows_of(text, f"Nodes of GWR-B: {ONE_AFTER_THE_OTHER}")
    assert apart["task 1"][0] == "0.00"
    assert apart["task 3"][1] == f"{np.linalg.norm(means[1] - means[2]):.2f}"
    by_task = rows_of(text, f"BGPO: {ONE_AFTER_THE_OTHER}")
    assert list(by_task) == [*TASKS, "all"]
    # Successes take 5, 6, ... steps: 8, 9 and 10 of them by seed.
    steps = [5 + n for seed in (9, 8, 10) for n in range(seed)]
    cells = ["90.0 [65, 100]", "90 80 100", "90.0", "not reached (3 of 3 seeds never)"]
    assert by_task[TASKS[0]] == [*cells, "50.0", "25.0", "99.00", f"{np.mean(steps):.1f}"]
    assert by_task["all"][:3] == ["90.0 [65, 100]", "90 80 100", ""]


def test_figures_are_written_beside_the_tables(reported):
    text = text_of(reported)
    figures = ["continual-3", "continual-3-counts", "continual-3-matrix", "continual-3-nodes"]
    for name in (*figures, "concurrent-3"):
        assert (reported / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"]({name}.png)" in text
    assert len(list(reported.glob("*.png"))) == 5


@pytest.mark.parametrize("tasks", [("juggle",), tuple("abcdefgh")])
def test_any_number_of_tasks_is_reported(tasks, tmp_path):
    starts = range(0, 32, 32 // len(tasks))
    for name, level in {"mine": 9, "bgpo": 2}.items():
        write_run(tmp_path, name, level, tasks=tasks, starts=(0,) * len(tasks))
        if len(tasks) > 1:
            write_run(tmp_path, name, level, tasks=tasks, starts=starts)
    report(ReportArguments((tmp_path,)))
    text = text_of(tmp_path)
    assert "nan" not in text
    kinds = ["all from the start"] + ["one after the other"] * (len(tasks) > 1)
    for kind in kinds:
        found = rows_of(text, f"{len(tasks)} task{'s' * (len(tasks) > 1)}, {kind}")
        assert found["mine"][1:3] == ["3", "90.0 [90, 90]"]
        assert found["mine"][4 : 4 + len(tasks)] == ["90.0"] * len(tasks)
        assert found["BGPO"][2] == "20.0 [20, 20]"


def test_a_single_seed_has_no_interval(tmp_path):
    for name, level in {"bgpo": [9], "oracle": [2]}.items():
        write_run(tmp_path, name, level)
    report(ReportArguments((tmp_path,)))
    text = text_of(tmp_path)
    assert rows_of(text, "3 tasks, all from the start")["BGPO"][1:3] == ["1", "90.0"]
    (row,) = rows_of(text, "Differences: 3 tasks, all from the start").values()
    assert row[:4] == ["+70.0", "not decided", "-", "-"]
    assert "nan" not in text


def test_a_run_that_is_read_only_is_reported_elsewhere(tmp_path, monkeypatch):
    run = write_run(tmp_path, "bgpo", 9, starts=STARTS)
    before = contents(run)
    # For root, permissions would not make it so.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != run)
    with pytest.raises(PermissionError, match=r"read-only.*--out"):
        report(ReportArguments((run,)))
    report(ReportArguments((run,), out=tmp_path / "report"))
    assert "## BGPO: " in text_of(tmp_path / "report")
    assert contents(run) == before


def test_reports_do_not_tell_the_folders_of_this_machine(tmp_path):
    run = write_run(tmp_path, "bgpo", 9)
    edit(run / "summary.json", command=f"python x.py --out {tmp_path}/bgpo --seeds 0 1")
    (write_run(tmp_path, "oracle", 5) / "eval.csv").unlink()
    printed = report(ReportArguments((tmp_path,)))
    assert str(tmp_path) not in printed and printed == text_of(tmp_path)
    assert "`python x.py --out .../bgpo --seeds 0 1`" in printed
    assert ".../concurrent-oracle holds no test episode" in printed


def test_tests_too_rare_for_phases_leave_that_table_out(tmp_path):
    write_run(tmp_path, "bgpo", 9, starts=(0, 1, 20))
    report(ReportArguments((tmp_path,)))
    assert "there is no evaluation in the 2 episodes before episode 1" in text_of(tmp_path)


def test_other_conditions_are_refused_before_anything_is_written(tmp_path):
    write_run(tmp_path, "bgpo", 9)
    write_run(tmp_path, "oracle", 5, held_out="test")
    before = contents(tmp_path)
    for archive in (None, tmp_path / "archive"):
        with pytest.raises(ValueError, match=r"differ in held_out \(validation and test\)"):
            report(ReportArguments((tmp_path,), archive=archive))
        assert contents(tmp_path) == before
    report(ReportArguments((tmp_path,), anyway=True))
    for title in ("3 tasks", "Differences: 3 tasks"):
        section = text_of(tmp_path).split(f"## {title}, all from the start\n")[1].split("\n## ")[0]
        assert "differ in held_out (validation and test)" in section


def test_the_report_on_an_archive_is_the_same_to_the_digit(reported, tmp_path):
    report(ReportArguments((reported,), archive=tmp_path / "archive"))
    assert text_of(tmp_path / "archive") == text_of(reported)
    report(ReportArguments((tmp_path / "archive",), out=tmp_path / "again"))
    assert text_of(tmp_path / "again") == text_of(reported)
    for path in (tmp_path / "again").glob("*.png"):
        assert path.read_bytes() == (reported / path.name).read_bytes()


def test_every_algorithm_has_a_name_in_tables():
    assert set(NAMES) == set(ALGORITHMS)


@pytest.fixture
def pair(tmp_path):
    """A run at 40, 50 and 40 %, and one of eight tenths of its length at 90, 80 and 100 %."""
    first = write_run(tmp_path, "oracle", [4, 5, 4], starts=STARTS)
    second = write_run(tmp_path, "bgpo", [9, 8, 10], starts=STARTS, episodes=32)
    return first, second


def compared(*runs, **options):
    text = report(ReportArguments(runs, compare=True, **options))
    return text, cells(text)[1:]


def test_two_runs_are_compared_seed_by_seed_on_the_episodes_of_both(pair):
    before = contents(pair[0].parent)
    text, (*tasks, mean) = compared(*pair, anyway=True)
    assert text.startswith(f"{pair[0]} and {pair[1]} differ in episodes (40 and 32)\n\n")
    assert f"{pair[0]} is cut at 32 of 40 episodes" in text
    assert [row[1] for row in tasks] == list(TASKS)
    # At episode 32, the first run is at half of its level, rounded down: 20 % in each seed.
    by_hand = statistics.difference([0.9, 0.8, 1.0], [0.2, 0.2, 0.2])
    assert mean == [
        *("last 10 %", "all", "20.0", "90.0"),
        *(by_hand.estimate.points(), "0.100", by_hand.note),
    ]
    assert [row[2:] for row in tasks] == [mean[2:]] * 3
    assert contents(pair[0].parent) == before


def test_runs_under_other_conditions_or_of_other_tasks_are_not_compared(pair, tmp_path):
    with pytest.raises(ValueError, match=r"differ in episodes \(40 and 32\)"):
        compared(*pair)
    edit(pair[0] / "config.json", episodes=32, held_out="test")
    with pytest.raises(ValueError, match=r"differ in held_out \(test and validation\)"):
        compared(*pair)
    assert "differ in held_out (test and validation)" in compared(*pair, anyway=True)[0]
    other = write_run(tmp_path, "ddpg", 3, tasks=("pull",), starts=(0,))
    with pytest.raises(ValueError, match="only runs of the same tasks"):
        compared(pair[0], other, anyway=True)


def test_success_is_shown_by_the_setting_in_which_runs_differ(tmp_path):
    for spread, level in ((1.0, [5, 7, 6]), (0.25, [9, 9, 9]), (0.0, [10, 10, 10])):
        write_run(tmp_path, "bgpo", level, directory=f"spread-{spread}", spread=spread)
    edit(tmp_path / "spread-1.0" / "summary.json", random_success=dict.fromkeys(TASKS, 0.04))
    archive = tmp_path / "archive"
    text = report(ReportArguments((tmp_path,), by="spread", archive=archive))
    assert text == text_of(archive)
    found = rows_of(text, "Success by spread: BGPO")
    assert [*found] == ["0", "0.25", "1"]
    assert found["0"] == ["3", *["100.0 [100, 100]"] * 4, "-"]
    assert found["1"] == ["3", *["60.0 [35, 85]"] * 4, "4 4 4"]
    assert (archive / "by-spread.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("oracle", {"spread": 0.5}, "one algorithm"),
        ("bgpo", {"spread": 0.5, "held_out": "test"}, "held_out"),
        ("bgpo", {"spread": 1.0}, "have 1.0"),
        ("bgpo", {"spread": "wide"}, "no number"),
        ("bgpo", {}, "no number"),
    ],
)
def test_runs_that_differ_in_more_than_one_number_are_refused(name, changes, message, tmp_path):
    write_run(tmp_path, "bgpo", 9, directory="a", spread=1.0)
    write_run(tmp_path, name, 9, directory="b", **changes)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=message):
        report(ReportArguments((tmp_path,), by="spread", archive=tmp_path / "archive"))
    assert contents(tmp_path) == before
