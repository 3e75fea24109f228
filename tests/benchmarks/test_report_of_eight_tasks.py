"""The report on runs of eight tasks whose success is made up by hand."""

import json

import numpy as np
import pytest

from benchmarks import report, summary
from bgpo_trl.analysis import comparison, eight_tasks
from bgpo_trl.runs.cost import Cost, write_costs
from suites import nico
from tests.benchmarks.test_report import rows_of, write_run

STARTS = tuple(range(0, 80, 10))
FINAL = "seed,demonstrations,task,episodes,success,task_inference"


def write_eight(folder, name, level, *, starts=STARTS, tasks=nico.ALL_TASKS, seeds=(0, 1)):
    """A finished run that succeeds in `level` of ten tests in the last fifth, in half before."""
    run = write_run(folder, name, level, episodes=80, starts=starts, seeds=seeds, tasks=tasks)
    told = {"commit": "abc", "command": "python x", "nodes": [9, 12], "groups": [8, 8]}
    (run / "summary.json").write_text(json.dumps(told | {"group_purity": [1.0, 1.0]}))
    train = [
        f"bgpo,{seed},{episode},9,{tasks[(episode - 1) // 10]},1,1,5,{episode},0,{groups}"
        for seed in seeds
        for episode in range(1, 81)
        for groups in [1 + (episode - 1) // 10]
    ]
    head = "algorithm,seed,episode,env_steps,task,success,return,steps,num_nodes,group,num_groups"
    (run / "train.csv").write_text("\n".join([head, *train]) + "\n")
    final = [
        f"{seed},{kind},{task},20,0.5,1.0"
        for seed in seeds
        for kind in ("seen", "held-out")
        for task in tasks
    ]
    (run / "final.csv").write_text("\n".join([FINAL, *final]) + "\n")
    write_costs(run / "cost.csv", {1: Cost(10, 0.1, 2.0), 8: Cost(20, 0.3, 9.0)})
    return run


@pytest.fixture
def drawn(monkeypatch):
    """Figures by file name, in place of files; and the arguments of the heat maps."""
    figures, plot = {}, report.plot_success_matrices

    def save(figure, path):
        path.write_bytes(b"")
        figures[path.name] = figure

    def plot_matrices(matrices, tasks):
        figures["matrices"], figures["tasks"] = matrices, tasks
        return plot(matrices, tasks)

    for module in (report, summary):
        monkeypatch.setattr(module, "save_figure", save)
    monkeypatch.setattr(report, "plot_success_matrices", plot_matrices)
    return figures


def test_report_of_two_runs_and_a_reference(tmp_path, drawn):
    write_eight(tmp_path, "eight-bgpo", 8)
    write_eight(tmp_path, "eight-oracle", 4)
    write_eight(tmp_path, "eight-concurrent-bgpo", 8, starts=(0,) * 8)
    report.main(report.Arguments(tmp_path))
    text = (tmp_path / "tables.md").read_text()
    names = ("eight", "eight-without", "eight-matrix", "eight-counts", "eight-concurrent")
    assert drawn.keys() - {"matrices", "tasks"} == {f"{name}.png" for name in names}
    table = rows_of(text, "Eight tasks, one after the other: the benchmark")
    # Tasks 1 to 6 are at 40 % after their phases, tasks 7 and 8 at 80 %, as all are in the end.
    measured = ["80.0 [80, 80]", "-", "-30.0 [-30, -30]", "34.3 [34, 34]"]
    assert table["BGPO"][:5] == ["no", *measured]
    assert table["BGPO"][6:] == ["10.5", "8", "0.0", "9"]
    assert table["BGPO"][5] != table["DDPG, told the label"][5] == "-"
    assert table["DDPG, told the label"][:3] == ["yes", "40.0 [40, 40]", "+40.0 [+40, +40]"]
    matrix = np.where(np.tri(8) == 1, 0.4, np.nan)
    matrix[6:] = np.where(np.tri(8)[6:] == 1, 0.8, np.nan)
    np.testing.assert_allclose(drawn["matrices"]["BGPO"], matrix)
    assert drawn["tasks"] == nico.ALL_TASKS
    cost = rows_of(text, "Eight tasks, one after the other: cost")
    assert cost["BGPO"] == ["10.0 ms, 2 MB", "15.0 ms, 9 MB"]
    assert "missing (eight-maml/eval.csv is not there, or empty)" in text
    assert "- missing: eight-reversed-bgpo, eight-reversed-bgpo-encoders-of-three," in text
    assert "Fig. 8" not in text and "the paper's claim" not in text


def test_a_run_before_its_last_task_is_left_out(tmp_path):
    write_eight(tmp_path, "eight-bgpo", 8)
    path = write_eight(tmp_path, "eight-oracle", 8) / "eval.csv"
    head, *lines = path.read_text().splitlines()
    early = [line for line in lines if int(line.split(",")[2]) <= 70]
    path.write_text("\n".join([head, *early]) + "\n")
    found, notes = comparison.read_group(tmp_path, eight_tasks.GROUPS["eight"])
    assert list(found) == ["eight-bgpo"]
    assert "DDPG, told the label: left out, no test of some task at episode 70" in notes


def test_runs_of_another_order_are_not_compared(tmp_path):
    write_eight(tmp_path, "eight-bgpo", 8)
    write_eight(tmp_path, "eight-oracle", 8, tasks=nico.ALL_TASKS[::-1])
    with pytest.raises(ValueError, match=r"eight-oracle has tasks .*on equal terms"):
        comparison.read_group(tmp_path, eight_tasks.GROUPS["eight"])


def test_summary_of_a_run_of_eight_tasks(tmp_path):
    described = summary.describe(write_eight(tmp_path, "eight-bgpo", 8))
    rows = [line.split("|")[1].strip() for line in described.splitlines() if line[:1] == "|"]
    assert rows[2:] == [*nico.ALL_TASKS, "all"]
    assert "A training step takes 10.0 ms with 1 and 15.0 ms with 8 tasks presented, 9 MB." in (
        described
    )


def test_a_run_of_another_algorithm_has_its_row_and_says_whether_it_knows_the_label(tmp_path):
    write_eight(tmp_path, "eight-bgpo", 8)
    write_eight(tmp_path, "eight-concurrent-mine", 4, starts=(0,) * 8)
    told = write_eight(tmp_path, "eight-mine", 4) / "summary.json"
    told.write_text(json.dumps({"needs_label": True}))
    # The least that a run of plain TorchRL must write.
    least = write_eight(tmp_path, "eight-plain", 6)
    config = json.loads((least / "config.json").read_text())
    kept = {key: config[key] for key in ("seeds", "tasks", "task_starts", "episodes")}
    (least / "config.json").write_text(json.dumps(kept))
    for path in least.iterdir():
        if path.name not in ("config.json", "eval.csv"):
            path.unlink()
    report.main(report.Arguments(tmp_path))
    text = (tmp_path / "tables.md").read_text()
    table = rows_of(text, "Eight tasks, one after the other: the benchmark")
    assert table["mine"][:2] == ["yes", "40.0 [40, 40]"]
    assert table["mine"][5] != "-"  # forward transfer, by its own reference
    assert table["plain"][:3] == ["?", "60.0 [60, 60]", "+20.0 [+20, +20]"]
    assert table["plain"][6:] == ["-"] * 4
    assert "mine" in rows_of(text, "Eight tasks, all from the start")


def reduce_to_the_least(path):
    """Leaves what a run of plain TorchRL must write."""
    config = json.loads((path / "config.json").read_text())
    kept = {key: config[key] for key in ("seeds", "tasks", "task_starts", "episodes")}
    (path / "config.json").write_text(json.dumps(kept))
    (path / "summary.json").write_text(json.dumps({"needs_label": False}))


def test_the_least_that_a_run_must_write_is_enough_by_itself(tmp_path):
    path = write_eight(tmp_path, "eight-plain", 6)
    reduce_to_the_least(path)
    report.main(report.Arguments(tmp_path))
    text = (tmp_path / "tables.md").read_text()
    table = rows_of(text, "Eight tasks, one after the other: the benchmark")
    assert table["plain"][:3] == ["no", "60.0 [60, 60]", "-"]
    found, notes = comparison.read_group(tmp_path, with_own_group(tmp_path))
    assert found["eight-plain"].eval_every == 2
    assert not [note for note in notes if "not finished" in note]
    assert "Commit" not in (tmp_path / "report.html").read_text()
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps({**config, "episodes": None}))
    with pytest.raises(ValueError, match=r"config.json is damaged"):
        report.main(report.Arguments(tmp_path))


def with_own_group(folder):
    return comparison.with_own(folder, eight_tasks.GROUPS)["eight"]


def test_an_own_run_on_other_terms_is_left_out_with_a_note(tmp_path):
    write_eight(tmp_path, "eight-bgpo", 8)
    write_eight(tmp_path, "eight-bgpo-trial", 8)
    path = tmp_path / "eight-bgpo-trial" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "eval_every": 3}))
    found, notes = comparison.read_group(tmp_path, with_own_group(tmp_path))
    assert list(found) == ["eight-bgpo"]
    (told,) = (note for note in notes if note.startswith("bgpo-trial: left out, since"))
    assert "has eval_every 3" in told


def test_a_run_is_finished_when_no_test_is_left_to_come(tmp_path):
    path = write_eight(tmp_path, "eight-bgpo", 8) / "config.json"
    config = json.loads(path.read_text())
    for more, told in ((0, False), (config["eval_every"] - 1, False), (config["eval_every"], True)):
        path.write_text(json.dumps({**config, "episodes": config["episodes"] + more}))
        _, notes = comparison.read_group(tmp_path, eight_tasks.GROUPS["eight"])
        assert any("not finished" in note for note in notes) is told


def test_bgpos_lead_is_that_of_bgpo_and_no_other(tmp_path):
    write_eight(tmp_path, "eight-my-bgpo", 8)
    write_eight(tmp_path, "eight-oracle", 4)
    report.main(report.Arguments(tmp_path))
    text = (tmp_path / "tables.md").read_text()
    table = rows_of(text, "Eight tasks, one after the other: the benchmark")
    assert table["my-bgpo"][2] == table["DDPG, told the label"][2] == "-"


def test_rare_tests_are_enough_for_the_end_of_training(tmp_path):
    path = write_eight(tmp_path, "eight-bgpo", 8)
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps(config | {"eval_every": 10}))
    head, *lines = (path / "eval.csv").read_text().splitlines()
    rare = [line for line in lines if int(line.split(",")[2]) % 10 == 0]
    (path / "eval.csv").write_text("\n".join([head, *rare]) + "\n")
    report.main(report.Arguments(tmp_path))
    text = (tmp_path / "tables.md").read_text()
    table = rows_of(text, "Eight tasks, one after the other: the benchmark")
    assert table["BGPO"][1] == "80.0 [80, 80]"
