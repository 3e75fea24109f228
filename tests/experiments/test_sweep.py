"""The grid of a sweep, and jobs on a cluster without Ray."""

import contextlib
import json
import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import eight_tasks
import pytest
from eight_tasks import EightTasksArguments

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import PRESETS
from bgpo_trl.encoders.pretrained import bank_path, default_weights, load_pretrained
from bgpo_trl.experiments import sweep
from bgpo_trl.experiments.sweep import SweepArguments
from bgpo_trl.runs.config_file import Digests, settings_of
from bgpo_trl.scenes import SCENES
from suites import nico
from tests.helpers import contents

ROOT = Path(__file__).parents[2]
# Two algorithms, two blocks of seeds.
FEW = {"algorithms": ("bgpo", "maml"), "seeds": (4, 0, 2), "block": 2, "preset": "quick"}


def write_run(job, digests=("some", "bank")):
    """Write the files by which a finished job is known."""
    job.directory.mkdir(parents=True, exist_ok=True)
    settings = settings_of(job.config, Digests(*digests))
    (job.directory / "config.json").write_text(json.dumps(settings))
    (job.directory / "final.csv").touch()
    (job.directory / "summary.json").write_text(f'{{"episodes": {job.config.episodes}}}')


def test_a_job_is_a_block_of_seeds_of_an_algorithm_in_a_setting(tmp_path):
    arguments = SweepArguments(
        algorithms=("bgpo", "dist-nll"),
        settings=("continual", "concurrent", "ablation"),
        seeds=(0, 1, 2, 5, 9),
        block=2,
        out=tmp_path,
    )
    grid = iter(sweep.make_jobs(arguments))
    for merged in (
        *("continual-bgpo", "continual-dist-nll", "concurrent-bgpo", "concurrent-dist-nll"),
        *("ablation-without-bonus", "ablation-without-gwr", "ablation-without-both"),
        *("ablation-group-balanced-replay", "ablation-demonstrations"),
    ):
        setting, name = merged.split("-", 1)
        starts = PRESETS["desk"].task_starts if setting == "continual" else (0, 0, 0)
        usual = replace(PRESETS["desk"], name=name, algorithm=ALGORITHMS[name].config)
        for seeds in ((0, 1), (2, 5), (9,)):
            job = next(grid)
            assert job.config == replace(usual, task_starts=starts, seeds=seeds)
            assert job.directory == tmp_path / merged / "-".join(map(str, ("seeds", *seeds)))
    assert not [*grid]


def test_jobs_carry_tasks_module_and_bank(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bank, tasks = Path("own.safetensors"), nico.PAPER_TASKS[:2]
    arguments = SweepArguments(settings=("continual",), tasks=tasks, module="my_tasks", bank=bank)
    (job,) = sweep.make_jobs(arguments)
    assert (job.config.tasks, job.config.task_starts) == (tasks, (0, 3_000))
    events = []

    def run_experiment(arguments, *_):
        events.append((arguments.bank, arguments.resume))
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "config.json").touch()

    monkeypatch.setattr(sweep, "import_plugin", events.append)
    monkeypatch.setattr(sweep, "run_experiment", run_experiment)
    for _ in range(2):
        sweep.play(job)
    path = tmp_path / bank
    assert events == ["my_tasks", (path, False), "my_tasks", (path, True)]


def test_the_benchmark_of_eight_tasks_is_a_grid_with_tests_every_50_episodes(monkeypatch):
    asked = []
    monkeypatch.setattr(eight_tasks, "sweep", lambda arguments: asked.append(arguments) or "done")
    for episodes in (4_000, 20):
        assert eight_tasks.eight_tasks(EightTasksArguments(episodes=episodes)) == "done"
    assert [arguments.eval_every for arguments in asked] == [50, 20]
    grid = sweep.make_jobs(asked[0])
    assert len(grid) == 3 * 8
    for job in grid:
        assert job.config.seeds == (20, 21, 22, 23, 24)
        assert (job.config.held_out, len(job.config.tasks)) == ("test", 8)
    more = SweepArguments(settings=("eight-sequential", "sequential"), episodes=4_000)
    config = {job.directory.parent.name: job.config for job in grid + sweep.make_jobs(more)}
    assert config["eight-bgpo"].task_starts == tuple(range(0, 4_000, 500))
    assert config["eight-concurrent-bgpo"].task_starts == (0,) * 8
    assert config["eight-reversed-bgpo"].tasks == nico.ALL_TASKS[::-1]
    unpractised = {name for name, of_runs in config.items() if of_runs.schedule == "sequential"}
    assert unpractised == {"eight-sequential-bgpo", "sequential-bgpo"}


def test_directories_of_other_runs_are_refused(tmp_path, refused):
    jobs = sweep.make_jobs(SweepArguments(out=tmp_path, **FEW))
    write_run(jobs[1])
    sweep.make_jobs(SweepArguments(out=tmp_path, **FEW))
    other = SweepArguments(out=tmp_path, episodes=7, **FEW)
    refused(lambda: sweep.sweep(other), "seeds-2 holds a run with other settings", "name another")


def test_a_finished_sweep_has_its_files_and_its_version_of_the_scene_alone(
    tmp_path, monkeypatch, refused
):
    weights = default_weights()
    encoders, bank = load_pretrained()
    same = SweepArguments(
        settings=("concurrent",), encoders=weights, bank=bank_path(weights), out=tmp_path
    )
    (job,) = sweep.make_jobs(same)
    write_run(job, (encoders.identity, bank.for_tasks(job.config.tasks).identity))
    for arguments in (same, replace(same, encoders=None, bank=None)):
        assert sweep.sweep(arguments).startswith("jobs: 1, run: 0;")
    none = tmp_path / "none.safetensors"
    others = replace(bank, embedding=bank.embedding + 1)
    others.save(tmp_path / "other.safetensors")
    eight = default_weights(nico.ALL_TASKS)
    for files, cause, remedy in (
        ({"encoders": eight}, "was begun with the encoders", "leave the flag out"),
        ({"encoders": none}, "no encoder weights", "train some"),
        ({"bank": tmp_path / "other.safetensors"}, "bank is ", "choose another"),
        ({"bank": none}, "none.safetensors", "bgpo bank"),
    ):
        refused(lambda files=files: sweep.sweep(replace(same, **files)), cause, remedy)
    monkeypatch.setitem(SCENES, "nico", replace(SCENES["nico"], version="2"))
    refused(
        lambda: sweep.sweep(replace(same, encoders=None, bank=None)),
        "scene_version is ",
        "choose another",
    )


def test_a_sweep_runs_each_job_once(tmp_path, monkeypatch):
    """In this process."""
    played, broken = [], ["concurrent-bgpo/seeds-4-0"]

    def play(job):
        played.append(str(job))
        if str(job) in broken:
            raise OSError("no space left")
        write_run(job)

    def play_jobs(todo, play, *, cpus, gpus):
        failed = {}
        for job in todo:
            try:
                sweep.work(job, play, sys.argv)
            except OSError as error:
                failed[job] = str(error)
        return failed

    monkeypatch.setattr(sweep, "connected", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr(sweep, "play_jobs", play_jobs)
    monkeypatch.setattr(sweep, "play", play)

    arguments = SweepArguments(out=tmp_path, episodes=4, **FEW)
    with pytest.raises(RuntimeError, match=f"^{broken[0]} failed: no space left$"):
        sweep.sweep(arguments)
    blocks = [f"concurrent-{name}/seeds-{s}" for name in ("bgpo", "maml") for s in ("4-0", "2")]
    assert played == blocks
    assert "OSError: no space left" in (tmp_path / broken[0] / "log.txt").read_text()

    broken.clear(), played.clear()
    sweep.sweep(arguments)
    assert played == blocks[:1]

    played.clear()
    before = contents(tmp_path)
    assert sweep.sweep(arguments).startswith("jobs: 4, run: 0;")
    assert contents(tmp_path) == before
    assert not played

    sweep.sweep(replace(arguments, algorithms=("maml",), seeds=(5, 3)))
    assert played == ["concurrent-maml/seeds-5-3"]


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
