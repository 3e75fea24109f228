"""Merging runs of different seeds, such as the jobs of a Slurm array."""

import json
import os
import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.merge import MergeArguments, merge
from bgpo_trl.experiments.paper import continual
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.runs.results import read_curves
from suites import nico
from tests.analysis.runs import edit
from tests.helpers import contents

ROOT = Path(__file__).parents[2]


def train(out, *seeds):
    """Do the job of a seed, as a command line with --resume does."""
    arguments = Arguments(algorithm="ddpg", seeds=seeds, out=out, resume=True, preset="quick")
    continual(arguments)
    return out


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder of runs that are trained once."""
    return tmp_path_factory.mktemp("trained")


@pytest.fixture
def jobs(undrawn, trained, tmp_path):
    """Finished runs of two seeds."""
    copies = []
    for seed in (8, 3):
        run = trained / f"seeds-{seed}"
        run = run if run.exists() else train(run, seed)
        copies.append(shutil.copytree(run, tmp_path / "all" / run.name))
    return tuple(copies)


def test_merged_jobs_are_reported_as_one_run_of_all_seeds(jobs, tmp_path):
    out = tmp_path / "all"
    whole = train(tmp_path / "whole", 8, 3)
    merge(MergeArguments(jobs, out))
    merged = contents(out)
    assert json.loads((out / "config.json").read_text())["seeds"] == [8, 3]
    ours, theirs = (read_curves(run / "eval.csv", nico.PAPER_TASKS) for run in (out, whole))
    assert ours.seeds == theirs.seeds == (3, 8)
    np.testing.assert_array_equal(ours.success, theirs.success)
    text = report(ReportArguments((out,), out=tmp_path / "report"))
    assert "| DDPG, told nothing | nothing | 2 |" in text

    merge(MergeArguments(jobs, out))
    assert contents(out) == merged
    more = train(out / "seeds-5", 5)
    merge(MergeArguments((*jobs, more), out))
    assert json.loads((out / "config.json").read_text())["seeds"] == [8, 3, 5]


def copied_job(jobs, **changes):
    """Return a copy of the second job, with some of its settings changed."""
    copy = shutil.copytree(jobs[1], jobs[1].with_name("copy"))
    edit(copy / "config.json", **changes)
    return copy


REFUSED = {
    "one run": (lambda jobs: jobs[:1], "two or more"),
    "a run twice": (lambda jobs: (*jobs, jobs[0]), "both have seed 8"),
    "no run": (lambda jobs: (*jobs, jobs[0].with_name("none")), "there is no run at"),
    "another interval of tests": (
        lambda jobs: (*jobs, copied_job(jobs, seeds=[4], eval_every=3)),
        "differ in eval_every (2 and 3)",
    ),
    "other hyperparameters": (
        lambda jobs: (*jobs, copied_job(jobs, seeds=[4], algorithm={"max_steps": 7})),
        "differ in algorithm.",
    ),
    "a run that is being extended": (
        lambda jobs: (jobs[0], copied_job(jobs, episodes=60)),
        "copy is not finished: continue it with --resume",
    ),
    "seeds in words": (lambda jobs: (jobs[0], copied_job(jobs, seeds=["3"])), "whole numbers"),
    "another seed than in the tables": (
        lambda jobs: (jobs[0], copied_job(jobs, seeds=[4])),
        "do not have each episode of each seed once",
    ),
}


@pytest.mark.parametrize(("choose", "cause"), REFUSED.values(), ids=REFUSED.keys())
def test_runs_that_are_not_one_run_are_not_merged(jobs, tmp_path, refused, choose, cause):
    chosen = choose(jobs)
    refused(lambda: merge(MergeArguments(chosen, tmp_path / "out")), cause, "")


def test_merging_replaces_no_other_results(jobs, tmp_path, refused):
    other = train(tmp_path / "other", 5)
    for out in (jobs[0], other):
        refused(lambda out=out: merge(MergeArguments(jobs, out)), "--out", "name another directory")
    merge(MergeArguments((*jobs, other), tmp_path / "all"))
    refused(lambda: merge(MergeArguments(jobs, tmp_path / "all")), "holds other results", "another")


def write_program(path, text):
    path.write_text(f"#!/bin/bash\n{text}\n")
    path.chmod(0o755)


def test_the_documented_slurm_array_requeues_interrupted_jobs_alone(tmp_path):
    page = (ROOT / "docs" / "benchmark.md").read_text()
    (script,) = re.findall(r"^```sh\n(#!/bin/bash\n.*?)^```", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "array.sh").write_text(script)
    programs = tmp_path / "programs"
    programs.mkdir()
    write_program(programs / "srun", 'exec "$@"')
    write_program(programs / "scontrol", 'echo "$2" >> queue')
    # Each job is interrupted once; the last one fails then.
    write_program(
        programs / "bgpo",
        'echo "$@" >> calls\n'
        'if [ "$(grep -c -- "--seeds $SLURM_ARRAY_TASK_ID " calls)" -eq 1 ]; then exit 75; fi\n'
        "exit $((SLURM_ARRAY_TASK_ID == 14))",
    )
    first, last = map(int, re.findall(r"--array=(\d+)-(\d+)", script)[0])
    queue, ended = [*range(first, last + 1)], Counter()
    while queue:
        seed = queue.pop(0)
        environment = {"SLURM_ARRAY_TASK_ID": str(seed), "SLURM_JOB_ID": str(seed)}
        environment["PATH"] = f"{programs}:{os.environ['PATH']}"
        job = subprocess.run(["bash", "array.sh"], cwd=tmp_path, env=environment, check=False)
        ended[seed, job.returncode] += 1
        requeued = tmp_path / "queue"
        if requeued.exists():
            queue += map(int, requeued.read_text().split())
            requeued.unlink()
    again = {(seed, 75): 1 for seed in range(first, last + 1)}
    assert ended == again | {(seed, int(seed == 14)): 1 for seed in range(first, last + 1)}
    calls = (tmp_path / "calls").read_text().splitlines()
    assert Counter(calls) == dict.fromkeys(calls, 2)
    for call in calls:
        assert "--resume" in call and re.search(r"--seeds (\d+) --out .*/seeds-\1$", call)
