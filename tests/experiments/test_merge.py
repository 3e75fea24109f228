"""Merging runs of different seeds, such as the jobs of a Slurm array."""

import json
import os
import re
import shutil
import subprocess
from collections import Counter
from functools import partial
from pathlib import Path

import pytest

from bgpo_trl.experiments.arguments import Arguments
from bgpo_trl.experiments.merge import MergeArguments, merge
from bgpo_trl.experiments.paper import continual
from bgpo_trl.experiments.ray_jobs import Job, _episodes, _planned_episodes
from bgpo_trl.runs.config_file import read_config
from tests.helpers import contents, edit, rows

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.usefixtures("easy_world")


def train(out, *seeds):
    """Do the job of a seed, as a command line with --resume does."""
    flags = ("--seeds", *map(str, seeds))
    arguments = Arguments(algorithm="ddpg", settings=flags, out=out, resume=True, preset="quick")
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


def test_merged_jobs_equal_one_run_of_all_seeds(jobs, tmp_path):
    out, whole = tmp_path / "all", train(tmp_path / "whole", 8, 3)
    merge(MergeArguments(jobs, out))
    merged = contents(out)
    assert (out / "config.json").read_bytes() == (whole / "config.json").read_bytes()
    for name in ("train.csv", "eval.csv"):
        ours, theirs = rows(out / name), rows(whole / name)
        theirs.sort(key=lambda row: (int(row["seed"]), int(row["episode"])))
        for key in ("loss_actor", "loss_value"):
            pair = [[float(row.pop(key, 0)) for row in table] for table in (ours, theirs)]
            assert pair[0] == pytest.approx(pair[1], rel=1e-3, abs=1e-5)
        assert ours == theirs != []
    job = Job(whole, read_config(whole / "config.json")[0])
    assert _episodes([job]) == _planned_episodes(job)

    merge(MergeArguments(jobs, out))
    assert contents(out) == merged
    more = train(out / "seeds-5", 5)
    merge(MergeArguments((*jobs, more), out))
    assert json.loads((out / "config.json").read_text())["seeds"] == [8, 3, 5]


def changed(**changes):
    """Return a function that adds a copy of the second job, with some of its settings changed."""

    def choose(jobs):
        copy = shutil.copytree(jobs[1], jobs[1].with_name("copy"))
        edit(copy / "config.json", **changes)
        return (jobs[0], copy)

    return choose


@pytest.mark.parametrize(
    ("choose", "cause"),
    [
        (lambda jobs: jobs[:1], "two or more"),
        (lambda jobs: (*jobs, jobs[0]), "both have seed 8"),
        (lambda jobs: (*jobs, jobs[0].with_name("none")), "there is no run at"),
        (changed(seeds=[4], eval_every=3), "differ in eval_every (2 and 3)"),
        (changed(seeds=[4], algorithm={"max_steps": 7}), "differ in algorithm."),
        (changed(episodes=60), "copy is not finished: continue it with --resume"),
        (changed(seeds=["3"]), "whole numbers"),
        (changed(seeds=[4]), "do not have each episode of each seed once"),
    ],
)
def test_runs_that_are_not_one_run_are_not_merged(jobs, tmp_path, refused, choose, cause):
    chosen = choose(jobs)
    refused(lambda: merge(MergeArguments(chosen, tmp_path / "out")), cause, "")


def test_merging_replaces_no_other_results(jobs, tmp_path, refused):
    other = train(tmp_path / "other", 5)
    for out in (jobs[0], other):
        call = partial(merge, MergeArguments(jobs, out))
        refused(call, "--out", "is a run of its own, name another directory")
    merge(MergeArguments((*jobs, other), tmp_path / "all"))
    again = partial(merge, MergeArguments(jobs, tmp_path / "all"))
    refused(again, "holds other results", "another")  # of more seeds
    edit(tmp_path / "all" / "config.json", seeds=[8, 3], eval_every=3)
    refused(again, "holds other results", "another")


def test_the_documented_slurm_array_requeues_interrupted_jobs_alone(tmp_path):
    page = (ROOT / "docs" / "benchmark.md").read_text()
    (script,) = re.findall(r"^```sh\n(#!/bin/bash\n.*?)^```", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "array.sh").write_text(script)
    # Each job is interrupted once; the last one fails then.
    programs = {
        "srun": 'exec "$@"',
        "scontrol": 'echo "$2" >> queue',
        "bgpo": 'echo "$@" >> calls\n'
        'if [ "$(grep -c -- "--seeds $SLURM_ARRAY_TASK_ID " calls)" -eq 1 ]; then exit 75; fi\n'
        "exit $((SLURM_ARRAY_TASK_ID == 14))",
    }
    for name, text in programs.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / name).chmod(0o755)
    first, last = map(int, re.findall(r"--array=(\d+)-(\d+)", script)[0])
    queue, ended, requeued = [*range(first, last + 1)], Counter(), tmp_path / "queue"
    while queue:
        seed = queue.pop(0)
        environment = {"SLURM_ARRAY_TASK_ID": str(seed), "SLURM_JOB_ID": str(seed)}
        environment["PATH"] = f"{tmp_path}:{os.environ['PATH']}"
        job = subprocess.run(["bash", "array.sh"], cwd=tmp_path, env=environment, check=False)
        ended[seed, job.returncode] += 1
        if requeued.exists():
            queue += map(int, requeued.read_text().split())
            requeued.unlink()
    again = {(seed, 75): 1 for seed in range(first, last + 1)}
    assert ended == again | {(seed, int(seed == 14)): 1 for seed in range(first, last + 1)}
    calls = (tmp_path / "calls").read_text().splitlines()
    assert Counter(calls) == dict.fromkeys(calls, 2)
    for call in calls:
        assert "--resume" in call and re.search(r"--seeds (\d+) --out .*/seeds-\1$", call)
