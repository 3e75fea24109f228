"""The grid of a sweep and the merging of its blocks of seeds, without Ray."""

import contextlib
import json
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import eight_tasks
import pytest
from eight_tasks import EightTasksArguments

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.configs import PRESETS
from bgpo_trl.experiments import merge, sweep
from bgpo_trl.experiments import ray_jobs as jobs
from bgpo_trl.experiments import run as experiment
from bgpo_trl.experiments.ray_jobs import Job
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.experiments.sweep import SweepArguments
from bgpo_trl.runs.config_file import Digests, settings_of
from bgpo_trl.runs.cost import Cost, read_costs, write_costs
from suites import nico
from tests.helpers import contents, rows

SOME = Digests("some", "bank")
BY_TASKS = {nico.PAPER_TASKS: SOME}
HEAD = "algorithm,seed,episode,env_steps,task,success,return,steps"
# Two algorithms, two blocks of seeds.
FEW = {"algorithms": ("bgpo", "maml"), "seeds": (4, 0, 2), "block": 2, "preset": "quick"}


def write_run(job):
    """Write the files of a finished job, with results that follow from seed and episode."""
    config, folder, seeds = job.config, job.directory, job.config.seeds
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(settings_of(config, SOME)))
    summary = {"commit": f"c{seeds[0] // 2}", "command": "a", "random_success": {"x": 0.5}}
    of_groups = {"nodes": [100 + seed for seed in seeds], "groups": [3 + seed for seed in seeds]}
    of_groups["group_purity"] = [1 - seed / 8 for seed in seeds]
    summary |= of_groups if config.name == "bgpo" else {"nodes": None, "groups": None}
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "gwr.csv").write_text(f"task,w0,w1\n0,1,2\n1,2,5\n2,0,{seeds[0]}\n")
    write_costs(folder / "cost.csv", {3: Cost(7, 0.5 * len(seeds), 2.0 * len(seeds))})
    for name in ("episodes.png", "success.png"):
        (folder / "figures" / name).write_text(str(seeds[0]))
    train, tests = [HEAD + ",loss_actor,num_nodes,num_groups"], [HEAD]
    for episode, seed in product(range(1, config.episodes + 1), seeds):
        row = f"{config.name},{seed},{episode},{7 * episode},{{}},{(seed + episode) % 2},0.1,5"
        train.append(row.format(nico.PAPER_TASKS[episode % 3]) + f",{seed}.25,9,3")
        if episode % config.eval_every == 0:
            tests += [row.format(task) for task in nico.PAPER_TASKS] * 2
    final = ["seed,demonstrations,task,success,task_inference"]
    for kind, task, seed in product(("seen", "held-out"), nico.PAPER_TASKS, seeds):
        final.append(f"{seed},{kind},{task},0.{seed},1.0")
    for name, lines in (("train.csv", train), ("eval.csv", tests), ("final.csv", final)):
        (folder / name).write_text("\n".join(lines) + "\n")


def test_a_job_is_a_block_of_seeds_of_an_algorithm_in_a_setting(tmp_path):
    arguments = SweepArguments(
        algorithms=("bgpo", "dist-nll"),
        settings=("continual", "concurrent", "ablation"),
        seeds=(0, 1, 2, 5, 9),
        block=2,
        out=tmp_path,
    )
    grid = sweep.make_jobs(arguments)
    assert [merged.name for merged in grid] == [
        *("continual-bgpo", "continual-dist-nll", "concurrent-bgpo", "concurrent-dist-nll"),
        *("ablation-without-bonus", "ablation-without-gwr", "ablation-without-both"),
        *("ablation-group-balanced-replay", "ablation-demonstrations"),
    ]
    for merged, group in grid.items():
        setting, name = merged.name.split("-", 1)
        starts = PRESETS["desk"].task_starts if setting == "continual" else (0, 0, 0)
        usual = replace(PRESETS["desk"], name=name, algorithm=ALGORITHMS[name].config)
        for job, seeds in zip(group, [(0, 1), (2, 5), (9,)], strict=True):
            assert job.config == replace(usual, task_starts=starts, seeds=seeds)
            assert job.directory == tmp_path / merged.name / "-".join(map(str, ("seeds", *seeds)))


def test_jobs_carry_tasks_module_and_bank(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bank, tasks = Path("own.safetensors"), nico.PAPER_TASKS[:2]
    arguments = SweepArguments(settings=("continual",), tasks=tasks, module="my_tasks", bank=bank)
    ((job,),) = sweep.make_jobs(arguments).values()
    assert (job.config.tasks, job.config.task_starts) == (tasks, (0, 3_000))
    events = []

    def run_experiment(arguments, *_):
        events.append((arguments.bank, arguments.resume))
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "config.json").touch()

    monkeypatch.setattr(sweep, "import_plugin", events.append)
    monkeypatch.setattr(experiment, "run_experiment", run_experiment)
    for _ in range(2):
        sweep.play(job)
    path = tmp_path / bank
    assert events == ["my_tasks", (path, False), "my_tasks", (path, True)]


def test_the_benchmark_of_eight_tasks_is_a_grid_with_tests_every_50_episodes(monkeypatch):
    asked = []
    monkeypatch.setattr(sweep, "sweep", lambda arguments: asked.append(arguments) or "done")
    for episodes in (4_000, 20):
        assert eight_tasks.eight_tasks(EightTasksArguments(episodes=episodes)) == "done"
    assert [arguments.eval_every for arguments in asked] == [50, 20]
    grid = sweep.make_jobs(asked[0])
    assert len(grid) == 3 * 8
    for group in grid.values():
        (job,) = group
        assert job.config.seeds == (10, 11, 12, 13, 14)
        assert (job.config.held_out, len(job.config.tasks)) == ("test", 8)
    more = SweepArguments(settings=("eight-sequential", "sequential"), episodes=4_000)
    config = {path.name: group[0].config for path, group in (grid | sweep.make_jobs(more)).items()}
    assert config["eight-bgpo"].task_starts == tuple(range(0, 4_000, 500))
    assert config["eight-concurrent-bgpo"].task_starts == (0,) * 8
    assert config["eight-reversed-bgpo"].tasks == nico.ALL_TASKS[::-1]
    unpractised = {name for name, of_runs in config.items() if of_runs.schedule == "sequential"}
    assert unpractised == {"eight-sequential-bgpo", "sequential-bgpo"}


@pytest.mark.parametrize(
    ("wrong", "cause"),
    [
        ({"block": 0}, "block"),
        ({"seeds": (1, 2, 1)}, "seeds"),
        ({"settings": ("eight",), "tasks": ("grasp_glass",)}, "--tasks"),
        ({"algorithms": ()}, "--algorithms"),
        ({"settings": ()}, "--settings"),
        ({"cpus_per_run": 0}, "--cpus-per-run"),
        ({"gpus_per_run": -1}, "--gpus-per-run"),
    ],
)
def test_wrong_grids_are_refused(tmp_path, wrong, cause):
    with pytest.raises(ValueError, match=cause):
        sweep.sweep(SweepArguments(out=tmp_path / "out", **wrong))
    assert not (tmp_path / "out").exists()


def test_directories_of_other_runs_are_refused(tmp_path):
    grid = sweep.make_jobs(SweepArguments(out=tmp_path, **FEW))
    sweep.check_directories(grid, BY_TASKS)  # there is nothing yet
    for group in grid.values():
        write_run(group[1])
    sweep.check_directories(grid, BY_TASKS)
    with pytest.raises(ValueError, match="encoders is some there and others here"):
        sweep.check_directories(grid, {nico.PAPER_TASKS: Digests("others", "bank")})
    longer = sweep.make_jobs(SweepArguments(out=tmp_path, episodes=7, **FEW))
    with pytest.raises(ValueError, match=r"seeds-2 holds a run with other settings .*episodes is"):
        sweep.check_directories(longer, BY_TASKS)

    alone = sweep.make_jobs(SweepArguments(out=tmp_path / "alone", **FEW))
    write_run(Job(tmp_path / "alone" / "concurrent-maml", alone.popitem()[1][0].config))
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="concurrent-maml is not a run of a sweep"):
        sweep.sweep(SweepArguments(out=tmp_path / "alone", **FEW))
    assert contents(tmp_path) == before


def test_merged_blocks_equal_one_run_of_all_seeds(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["-m", "bgpo_trl", "sweep", "--block", "2"])
    arguments = SweepArguments(out=tmp_path / "blocks", episodes=6, **FEW)
    for merged, group in sweep.make_jobs(arguments).items():
        whole = Job(tmp_path / "whole" / merged.name, replace(group[0].config, seeds=(4, 0, 2)))
        for job in (*group, whole):
            write_run(job)
        merge.merge_runs([job.directory for job in group], merged)
        for name in ("train.csv", "eval.csv", "final.csv"):
            theirs = rows(whole.directory / name)
            theirs.sort(key=lambda row: (int(row["seed"]), int(row.get("episode", 0))))
            assert rows(merged / name) == theirs != []
        of_blocks, of_whole = (
            {name: json.loads((run / f"{name}.json").read_text()) for name in ("config", "summary")}
            for run in (merged, whole.directory)
        )
        told = {"commit": "c2 c1", "command": "python -m bgpo_trl sweep --block 2"}
        assert of_blocks == {**of_whole, "summary": of_whole["summary"] | told}
        assert read_costs(merged / "cost.csv") == {3: Cost(14, 1.5, 6.0)}  # of two blocks
        figures = {path.name: path.read_text() for path in (merged / "figures").iterdir()}
        assert figures == {"episodes.png": "4"}
        assert (merged / "gwr.csv").read_text() == (whole.directory / "gwr.csv").read_text()
    texts = []
    for folder in ("blocks", "whole"):
        report(ReportArguments((tmp_path / folder,)))
        text = (tmp_path / folder / "tables.md").read_text()
        texts.append(text.partition("## GWR-B, by seed")[0])
    assert texts[0] == texts[1]


def test_merging_again_changes_nothing_and_a_gap_is_not_merged(tmp_path):
    merged, group = sweep.make_jobs(SweepArguments(out=tmp_path, episodes=4, **FEW)).popitem()
    for job in group:
        write_run(job)
    blocks = [job.directory for job in group]
    merge.merge_runs(blocks, merged)
    before = contents(tmp_path)
    merge.merge_runs(blocks, merged)
    assert contents(tmp_path) == before
    train = blocks[1] / "train.csv"
    lines = train.read_text().splitlines(keepends=True)
    for broken in (lines[:-1], [*lines, lines[-1]], [*lines[:-1], lines[1]]):
        train.write_text("".join(broken))
        with pytest.raises(ValueError, match="do not have each episode of each seed once"):
            merge.merge_runs(blocks, merged)
        train.write_text("".join(lines))
        assert contents(tmp_path) == before
    (blocks[0] / "final.csv").unlink()
    with pytest.raises(ValueError, match=r"final\.csv is missing"):
        merge.merge_runs(blocks, merged)


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
                jobs.work(job, play, sys.argv)
            except OSError as error:
                failed[job] = str(error)
        return failed

    monkeypatch.setattr(sweep, "connected", lambda *_, **__: contextlib.nullcontext())
    monkeypatch.setattr(sweep, "play_jobs", play_jobs)
    monkeypatch.setattr(sweep, "play", play)
    some = [SimpleNamespace(identity=digest) for digest in SOME]
    monkeypatch.setattr(experiment, "pretrained_for", lambda tasks, bank, **_: some)

    arguments = SweepArguments(out=tmp_path, episodes=4, **FEW)
    with pytest.raises(RuntimeError, match=f"^{broken[0]} failed: no space left$"):
        sweep.sweep(arguments)
    blocks = [f"concurrent-{name}/seeds-{s}" for name in ("bgpo", "maml") for s in ("4-0", "2")]
    assert played == blocks
    assert not (tmp_path / "concurrent-bgpo" / "eval.csv").exists()
    assert (tmp_path / "concurrent-maml" / "eval.csv").exists()
    assert "OSError: no space left" in (tmp_path / broken[0] / "log.txt").read_text()

    broken.clear(), played.clear()
    sweep.sweep(arguments)
    assert played == blocks[:1]
    assert (tmp_path / "concurrent-bgpo" / "eval.csv").exists()

    played.clear()
    before = contents(tmp_path)
    assert sweep.sweep(arguments).startswith("jobs: 4, to run: 0\n")
    assert contents(tmp_path) == before
    assert not played

    sweep.sweep(replace(arguments, algorithms=("maml",), seeds=(4, 0, 2, 5, 3, 1), block=2))
    assert played == [f"concurrent-maml/seeds-{block}" for block in ("2-5", "3-1")]
    seeds = [row["seed"] for row in rows(tmp_path / "concurrent-maml" / "train.csv")]
    assert seeds == sorted(4 * "012345")
