"""The grid of a sweep and the merging of its blocks of seeds, without Ray."""

import contextlib
import json
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import pytest

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.analysis.comparison import NAMES
from bgpo_trl.configs import PRESETS
from bgpo_trl.experiments import merge, sweep
from bgpo_trl.experiments import ray_jobs as jobs
from bgpo_trl.experiments import run as experiment
from bgpo_trl.experiments.ray_jobs import Job
from bgpo_trl.experiments.report import ReportArguments, report
from bgpo_trl.experiments.sweep import EightTasksArguments, SweepArguments
from bgpo_trl.runs.config_file import Digests, settings_of
from bgpo_trl.runs.cost import Cost, read_costs, write_costs
from bgpo_trl.training import Trainer
from suites import nico
from tests.helpers import contents, rows

SOME = Digests("some", "bank")
BY_TASKS = {nico.PAPER_TASKS: SOME}
HEAD = "algorithm,seed,episode,env_steps,task,success,return,steps"


def write_run(job):
    """Write the files of a finished job, with results that follow from seed and episode."""
    config, folder = job.config, job.directory
    folder.mkdir(parents=True, exist_ok=True)
    settings = settings_of(config, SOME)
    (folder / "config.json").write_text(json.dumps(settings))
    summary = {"commit": f"c{config.seeds[0] // 2}", "command": "a", "random_success": {"x": 0.5}}
    summary["nodes"] = [100 + seed for seed in config.seeds] if config.name == "bgpo" else None
    summary["groups"] = [3 + seed for seed in config.seeds] if config.name == "bgpo" else None
    if config.name == "bgpo":
        summary["group_purity"] = [1 - seed / 8 for seed in config.seeds]
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "gwr.csv").write_text(f"task,w0,w1\n0,1,2\n1,2,5\n2,0,{config.seeds[0]}\n")
    n_seeds = len(config.seeds)
    write_costs(folder / "cost.csv", {3: Cost(7, 0.5 * n_seeds, 2.0 * n_seeds)})
    (folder / "figures").mkdir(exist_ok=True)
    for name in ("episodes.png", "success.png"):
        (folder / "figures" / name).write_text(str(config.seeds[0]))
    train, tests = [HEAD + ",loss_actor,num_nodes,num_groups"], [HEAD]
    final = ["seed,demonstrations,task,success,task_inference"]
    for episode, seed in product(range(1, config.episodes + 1), config.seeds):
        row = f"{config.name},{seed},{episode},{7 * episode},{{}},{(seed + episode) % 2},0.1,5"
        train.append(row.format(nico.PAPER_TASKS[episode % 3]) + f",{seed}.25,9,3")
        if episode % config.eval_every == 0:
            tests += [row.format(task) for task in nico.PAPER_TASKS] * 2
    for kind, task, seed in product(("seen", "held-out"), nico.PAPER_TASKS, config.seeds):
        final.append(f"{seed},{kind},{task},0.{seed},1.0")
    for name, lines in (("train.csv", train), ("eval.csv", tests), ("final.csv", final)):
        (folder / name).write_text("\n".join(lines) + "\n")


@pytest.fixture
def few():
    """Four jobs: two algorithms, two blocks of seeds."""
    return {"algorithms": ("bgpo", "maml"), "seeds": (4, 0, 2), "block": 2, "preset": "quick"}


def test_a_job_is_a_block_of_seeds_of_an_algorithm_in_a_setting(tmp_path):
    arguments = SweepArguments(
        algorithms=("bgpo", "dist-nll"),
        settings=("continual", "concurrent", "ablation"),
        seeds=(0, 1, 2, 5, 9),
        block=2,
        out=tmp_path,
    )
    grid = sweep.make_jobs(arguments)
    assert [merged.relative_to(tmp_path).as_posix() for merged in grid] == [
        *("continual-bgpo", "continual-dist-nll", "concurrent-bgpo", "concurrent-dist-nll"),
        *("ablation-without-bonus", "ablation-without-gwr", "ablation-without-both"),
        *("ablation-group-balanced-replay", "ablation-demonstrations"),
    ]
    assert {group[0].config.name for group in grid.values()} <= set(NAMES)
    for merged, group in grid.items():
        assert [job.config.seeds for job in group] == [(0, 1), (2, 5), (9,)]
        assert [job.directory.name for job in group] == ["seeds-0-1", "seeds-2-5", "seeds-9"]
        setting, name = merged.name.split("-", 1)
        starts = PRESETS["desk"].task_starts if setting == "continual" else (0, 0, 0)
        for job in group:
            assert job.directory.parent == merged
            assert job.config.name == name
            assert job.config.task_starts == starts
            algorithm = job.config.algorithm
            assert algorithm == ALGORITHMS[name].config
            assert replace(PRESETS["desk"], algorithm=algorithm) == replace(
                job.config,
                seeds=PRESETS["desk"].seeds,
                task_starts=PRESETS["desk"].task_starts,
                name="bgpo",
            )
            assert hasattr(algorithm, "beta") == (name != "dist-nll")


def test_jobs_carry_tasks_module_and_bank(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bank, tasks = Path("own.safetensors"), nico.PAPER_TASKS[:2]
    arguments = SweepArguments(
        settings=("continual", "concurrent"), tasks=tasks, module="my_tasks", bank=bank
    )
    (continual,), (concurrent,) = sweep.make_jobs(arguments).values()
    assert (continual.config.task_starts, concurrent.config.task_starts) == ((0, 3_000), (0, 0))
    for job in (continual, concurrent):
        assert job.config.tasks == tasks
        assert (job.module, job.bank) == ("my_tasks", tmp_path / bank)
    events = []
    monkeypatch.setattr(sweep, "import_plugin", events.append)
    monkeypatch.setattr(
        experiment, "run_experiment", lambda arguments, *_: events.append(arguments.bank)
    )
    sweep.play(continual)
    assert events == ["my_tasks", tmp_path / bank]


def test_the_benchmark_of_eight_tasks_is_a_grid_with_tests_every_50_episodes(monkeypatch):
    asked = []
    monkeypatch.setattr(sweep, "sweep", lambda arguments: asked.append(arguments) or "done")
    for episodes in (4_000, 20):
        assert sweep.eight_tasks(EightTasksArguments(episodes=episodes)) == "done"
    assert [arguments.eval_every for arguments in asked] == [50, 20]
    grid = sweep.make_jobs(asked[0])
    assert len(grid) == 3 * 8
    more = SweepArguments(settings=("eight-sequential", "sequential"), episodes=4_000)
    config = {path.name: group[0].config for path, group in (grid | sweep.make_jobs(more)).items()}
    assert config["eight-bgpo"].task_starts == tuple(range(0, 4_000, 500))
    assert config["eight-concurrent-bgpo"].task_starts == (0,) * 8
    assert config["eight-reversed-bgpo"].tasks == nico.ALL_TASKS[::-1]
    assert config["sequential-bgpo"].tasks == nico.PAPER_TASKS
    unpractised = {name for name, of_runs in config.items() if of_runs.schedule == "sequential"}
    assert unpractised == {"eight-sequential-bgpo", "sequential-bgpo"}
    for group in grid.values():
        (job,) = group
        assert job.config.seeds == (10, 11, 12, 13, 14)
        assert (job.config.held_out, len(job.config.tasks)) == ("test", 8)


@pytest.mark.parametrize(
    "wrong",
    [
        {"block": 0},
        {"seeds": (1, 2, 1)},
        {"settings": ("eight",), "tasks": ("grasp_glass",)},
        {"algorithms": ()},
        {"settings": ()},
        {"cpus_per_run": 0},
        {"gpus_per_run": -1},
    ],
)
def test_wrong_grids_are_refused(tmp_path, wrong):
    with pytest.raises(ValueError):
        sweep.sweep(SweepArguments(out=tmp_path / "out", **wrong))
    assert not (tmp_path / "out").exists()


def test_directories_of_other_runs_are_refused(few, tmp_path):
    grid = sweep.make_jobs(SweepArguments(out=tmp_path, **few))
    sweep.check_directories(grid, BY_TASKS)  # there is nothing yet
    for group in grid.values():
        write_run(group[1])
    sweep.check_directories(grid, BY_TASKS)
    with pytest.raises(ValueError, match="encoders is some there and others here"):
        sweep.check_directories(grid, {nico.PAPER_TASKS: Digests("others", "bank")})
    longer = sweep.make_jobs(SweepArguments(out=tmp_path, episodes=7, **few))
    with pytest.raises(ValueError, match=r"seeds-2 holds a run with other settings .*episodes is"):
        sweep.check_directories(longer, BY_TASKS)

    alone = sweep.make_jobs(SweepArguments(out=tmp_path / "alone", **few))
    write_run(Job(tmp_path / "alone" / "concurrent-maml", alone.popitem()[1][0].config))
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="concurrent-maml is not a run of a sweep"):
        sweep.sweep(SweepArguments(out=tmp_path / "alone", **few))
    assert contents(tmp_path) == before


def test_merged_blocks_equal_one_run_of_all_seeds(few, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["-m", "bgpo_trl", "sweep", "--block", "2"])
    arguments = SweepArguments(out=tmp_path / "blocks", episodes=6, **few)
    for merged, group in sweep.make_jobs(arguments).items():
        whole = Job(tmp_path / "whole" / merged.name, replace(group[0].config, seeds=(4, 0, 2)))
        for job in (*group, whole):
            write_run(job)
        merge.merge_runs([job.directory for job in group], merged)
        for name in ("train.csv", "eval.csv", "final.csv"):
            ours, theirs = rows(merged / name), rows(whole.directory / name)
            assert len(ours) == len(theirs) > 0
            theirs.sort(key=lambda row: (int(row["seed"]), int(row.get("episode", 0))))
            assert ours == theirs
        config = json.loads((merged / "config.json").read_text())
        assert config == json.loads((whole.directory / "config.json").read_text())
        assert read_costs(merged / "cost.csv") == {3: Cost(14, 1.5, 6.0)}  # of two blocks
        summary = json.loads((merged / "summary.json").read_text())
        found = merged.name.endswith("bgpo")
        assert summary.pop("group_purity", None) == ([0.5, 1.0, 0.75] if found else None)
        assert summary == {
            "commit": "c2 c1",
            "command": "python -m bgpo_trl sweep --block 2",
            "random_success": {"x": 0.5},
            "nodes": [104, 100, 102] if found else None,
            "groups": [7, 3, 5] if found else None,
        }
        assert {path.name for path in (merged / "figures").iterdir()} == {"episodes.png"}
        assert (merged / "figures" / "episodes.png").read_text() == "4"
        assert (merged / "gwr.csv").read_text() == "task,w0,w1\n0,1,2\n1,2,5\n2,0,4\n"
    texts = []
    for folder in ("blocks", "whole"):
        report(ReportArguments((tmp_path / folder,)))
        text = (tmp_path / folder / "tables.md").read_text()
        texts.append("".join(text.partition("## GWR-B, by seed")[:1]))
        assert "| BGPO | ? | 3 |" in text and "| BGPO against MAML |" in text
    assert texts[0] == texts[1]


def test_merging_again_changes_nothing_and_a_gap_is_not_merged(few, tmp_path):
    merged, group = sweep.make_jobs(SweepArguments(out=tmp_path, episodes=4, **few)).popitem()
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


@pytest.mark.usefixtures("easy_world")
def test_merged_blocks_of_real_runs_equal_one_run_of_all_seeds(
    encoders, bank, make_config, tmp_path
):
    def train(folder, seeds):
        job = Job(tmp_path / folder, make_config(seeds=seeds, episodes=6))
        write_run(job)
        for name in ("config.json", "train.csv", "eval.csv"):
            (job.directory / name).unlink()
        Trainer(job.config, job.directory, bank=bank, encoders=encoders, progress=False).run()
        assert jobs._episodes([job]) == jobs._planned_episodes(job)
        return job.directory

    whole = train("whole", (8, 3))
    merge.merge_runs([train("first", (8,)), train("second", (3,))], tmp_path / "merged")
    config = (tmp_path / "merged" / "config.json").read_text()
    assert config == (whole / "config.json").read_text()
    for name in ("train.csv", "eval.csv"):
        ours, theirs = rows(tmp_path / "merged" / name), rows(whole / name)
        theirs.sort(key=lambda row: (int(row["seed"]), int(row["episode"])))
        for key in ("intrinsic_return", "loss_actor", "loss_value"):
            pair = [[float(row.pop(key, 0)) for row in table] for table in (ours, theirs)]
            assert pair[0] == pytest.approx(pair[1], rel=1e-3, abs=1e-5)
        assert ours == theirs
        assert len(ours) > 0


@pytest.fixture
def without_ray(monkeypatch):
    """The sweep in this process: `played` lists its jobs, `broken` names those that fail."""
    played, broken = [], set()

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
    return SimpleNamespace(played=played, broken=broken)


def test_a_sweep_runs_each_job_once(without_ray, few, tmp_path):
    played, broken = without_ray.played, without_ray.broken
    arguments = SweepArguments(out=tmp_path, episodes=4, **few)
    bgpo = ["concurrent-bgpo/seeds-4-0", "concurrent-bgpo/seeds-2"]
    maml = ["concurrent-maml/seeds-4-0", "concurrent-maml/seeds-2"]
    broken.add(bgpo[0])
    with pytest.raises(RuntimeError, match=f"^{bgpo[0]} failed: no space left$"):
        sweep.sweep(arguments)
    assert played == bgpo + maml
    assert not (tmp_path / "concurrent-bgpo" / "eval.csv").exists()
    assert (tmp_path / "concurrent-maml" / "eval.csv").exists()
    assert "OSError: no space left" in (tmp_path / bgpo[0] / "log.txt").read_text()

    broken.clear(), played.clear()
    sweep.sweep(arguments)
    assert played == bgpo[:1]
    config = json.loads((tmp_path / "concurrent-bgpo" / "config.json").read_text())
    assert config["seeds"] == [4, 0, 2]

    played.clear()
    before = contents(tmp_path)
    assert sweep.sweep(arguments).startswith("jobs: 4, to run: 0\n")
    assert contents(tmp_path) == before
    assert not played

    sweep.sweep(replace(arguments, algorithms=("maml",), seeds=(4, 0, 2, 5, 3, 1), block=2))
    assert played == [f"concurrent-maml/seeds-{block}" for block in ("2-5", "3-1")]
    seeds = [row["seed"] for row in rows(tmp_path / "concurrent-maml" / "train.csv")]
    assert seeds == sorted(4 * "012345")
