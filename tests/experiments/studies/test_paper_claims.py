"""Tests of the paper's claims on the rows of unfinished runs."""

import json

import numpy as np
import pandas as pd
import paper_claims
import pytest
from paper_claims import ClaimsArguments

from tests.analysis.runs import TASKS
from tests.helpers import cells, edit

SHARED = {"tasks": [*TASKS], "spread": 0.25, "task_starts": [0, 0, 0], "schedule": "practised"}
SHARED |= {"held_out": "test", "eval_every": 10, "episodes": 500}


def write(folder, algorithm, seed, episodes, late):
    """Write a run whose tests fail but for a share ``late`` from episode 90 on, 10 a task."""
    path = folder / f"{algorithm}-{seed}"
    path.mkdir()
    (path / "config.json").write_text(json.dumps(SHARED | {"name": algorithm, "seeds": [seed]}))
    row = {"algorithm": algorithm, "seed": seed}
    trained = pd.DataFrame(
        {"episode": np.arange(1, episodes + 1), "num_nodes": 7, "task": TASKS[0], **row}
    )
    trained["success"] = 0
    trained.to_csv(path / "train.csv", index=False)
    tests = [
        {
            **row,
            "episode": end,
            "task": task,
            "success": int(end >= 90 and n < 10 * late),
            "steps": 4,
        }
        for end in range(10, episodes + 1, 10)
        for task in TASKS
        for n in range(10)
    ]
    pd.DataFrame(tests).to_csv(path / "eval.csv.gz", index=False)


def test_rows_count_up_to_the_episode_that_all_runs_have_reached(tmp_path, monkeypatch):
    monkeypatch.setattr(paper_claims, "N_RANDOM", 1)
    # Success after episode 100, which the shortest run has not reached, must not count.
    for seed, episodes in enumerate((100, 200)):
        write(tmp_path, "slow", seed, episodes, 0.2)
        write(tmp_path, "fast", seed, episodes, 0.8 + 0.2 * seed)
    text = paper_claims.paper_claims(ClaimsArguments(tmp_path))
    assert text == (tmp_path / "claims.md").read_text()
    assert (tmp_path / "claims.png").exists()
    scores, contrasts = text.split("\n\n")[1:3]
    found = {row[0]: row[1:] for row in cells(scores)[1:]}
    # The last fifth of 100 episodes has two tests, 90 and 100, of ten.
    assert found["slow"][:3] == ["20.0", "20 20", "4.0"]
    assert found["fast"][1] == "80 100"
    assert found["fast"][-2:] == ["4.0", "7 7"]
    assert cells(contrasts)[1][2].startswith("+70.0")


def test_arms_of_one_algorithm_are_told_apart_by_their_folders(tmp_path):
    for arm, settings in (("without-bonus", {"beta": 0.0}), ("slow", {"beta": 0.1})):
        write(tmp_path, "slow", 0, 100, 0.5)
        changed = {"algorithm": settings, "episodes": 100 + len(arm)}
        edit(tmp_path / "slow-0" / "config.json", **changed)
        (tmp_path / "slow-0").rename(tmp_path / f"{arm}-0")
    runs, reached = paper_claims.runs_of(tmp_path)
    assert [*runs] == ["slow", "without-bonus"]
    assert reached == 100
    write(tmp_path, "slow", 1, 100, 0.5)
    with pytest.raises(ValueError, match="an arm with other settings"):
        paper_claims.runs_of(tmp_path)


def test_a_task_counts_in_the_area_from_when_it_is_presented(tmp_path, monkeypatch):
    monkeypatch.setattr(paper_claims, "N_RANDOM", 1)
    write(tmp_path, "slow", 0, 100, 0.5)
    path = tmp_path / "slow-0" / "eval.csv.gz"
    tests = pd.read_csv(path)
    # Task 1 succeeds in eight of ten evaluations, before the others are presented.
    tests = tests[(tests.task == TASKS[0]) | (tests.episode >= 90)]
    tests["success"] = (tests.episode < 90).astype(int)
    tests.to_csv(path, index=False)
    text = paper_claims.paper_claims(ClaimsArguments(tmp_path))
    row = next(row for row in cells(text.split("\n\n")[1]) if row[0] == "slow")
    assert row[3] == "80.0"


def test_runs_of_other_conditions_are_refused(tmp_path):
    write(tmp_path, "slow", 0, 20, 0.5)
    write(tmp_path, "fast", 0, 20, 0.5)
    edit(tmp_path / "fast-0" / "config.json", spread=1.0)
    with pytest.raises(ValueError, match="differ in spread"):
        paper_claims.paper_claims(ClaimsArguments(tmp_path))
