"""The summary of runs."""

import csv
import json
import math

import pytest

from benchmarks import summary
from bgpo_trl.runs.logger import EVAL_COLUMNS
from suites import nico

TASKS = nico.PAPER_TASKS


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


def test_a_rung_that_never_gets_there(tmp_path):
    write_tests(tmp_path / "eval.csv", {100: ([1], [1], [0])})
    table = summary.summarize(tmp_path / "eval.csv")
    assert table.pop("episodes to 80 %") == math.inf
    assert table["overall"] == pytest.approx(2 / 3)


def test_the_best_part_of_a_run_is_the_best_mean_over_a_tenth(tmp_path):
    def outcomes(success):
        return [success], [success], [success]

    successes = {100 * (i + 1): outcomes(float(8 <= i < 12)) for i in range(40)}
    write_tests(tmp_path / "eval.csv", successes)  # a tenth is 400 episodes, four tests
    assert set(summary.best(tmp_path / "eval.csv").values()) == {1.0}
    successes = {100 * (i + 1): outcomes(float(8 <= i < 10)) for i in range(40)}
    write_tests(tmp_path / "eval.csv", successes)
    assert set(summary.best(tmp_path / "eval.csv").values()) == {0.5}


def test_the_length_of_a_task_is_that_of_its_late_successes(tmp_path):
    rows = ["algorithm,seed,episode,task,success,steps"]
    for seed, episode, success, steps in [
        (0, 90, 1, 40),  # not among the last tenth
        (0, 100, 1, 4),
        (0, 100, 0, 50),
        (1, 100, 1, 7),
    ]:
        rows.append(f"bgpo,{seed},{episode},{TASKS[0]},{success},{steps}")
    rows.append(f"bgpo,0,100,{TASKS[1]},0,50")
    (tmp_path / "eval.csv").write_text("\n".join(rows) + "\n")

    assert summary.lengths(tmp_path / "eval.csv") == {TASKS[0]: 5.5}


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
