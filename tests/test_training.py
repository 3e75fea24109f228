"""Whole runs, small ones: what they write, and that no interrupt changes it."""

import csv
import itertools
import re
import signal
from collections import Counter, defaultdict
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from bgpo_trl import training
from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.algorithms.policy import Policy
from bgpo_trl.envs import NicoEnv
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.runs.cost import n_bytes, read_costs
from bgpo_trl.training import Trainer
from tests.conftest import of_name
from tests.folders import contents

pytestmark = pytest.mark.usefixtures("easy_world")
CSV_FILES = ("train.csv", "eval.csv")
TASKS = ("grasp_glass", "push_green_to_glass", "push_green_to_white")
LOSSES = ("loss_actor", "loss_value")
NAMES = [name for name in ALGORITHMS if not name.startswith("without-")]
every_algorithm = pytest.mark.parametrize("name", NAMES)
every_learner = pytest.mark.parametrize("name", [*NAMES, "bgpo+td3", "bgpo+sac"])
# Those whose tasks each need data of their own begin to learn later, and are given more.
LONGER = {"maml": {"episodes": 16}, "dist-nll": {"episodes": 16}}


@pytest.fixture(scope="module")
def make(bank, encoders, make_config):
    def make(directory, config=None, **arguments):
        parts = {"bank": bank, "encoders": encoders, "progress": False, **arguments}
        return Trainer(config or make_config(), directory, **parts)

    return make


@pytest.fixture(scope="module")
def run_of(make, make_config, easy_world, tmp_path_factory):
    """Plays a run of an algorithm to its end, once."""
    directories = {}

    def run_of(name):
        if name not in directories:
            directories[name] = tmp_path_factory.mktemp(name)
            make(directories[name], make_config(name=name, **of_name(LONGER, name))).run()
        return directories[name]

    return run_of


@pytest.fixture(scope="module")
def uninterrupted(run_of):
    return run_of("bgpo")


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def assert_equal(first, second, where="state"):
    """Compares nested containers bit for bit."""
    assert type(first) is type(second), where
    if isinstance(first, dict):
        assert list(first) == list(second), where
        for key in first:
            assert_equal(first[key], second[key], f"{where}[{key!r}]")
    elif isinstance(first, list | tuple):
        assert len(first) == len(second), where
        for index, pair in enumerate(zip(first, second, strict=True)):
            assert_equal(*pair, f"{where}[{index}]")
    elif isinstance(first, torch.Tensor):
        assert first.equal(second), where
    else:
        assert first == second, where


def assert_same_run(first, second):
    for name in CSV_FILES:
        # Line by line: pytest would take minutes to show where long byte strings differ.
        lines = [(run / name).read_text().splitlines() for run in (first, second)]
        assert lines[0] == lines[1]
    graphs = [{p.name: p.read_bytes() for p in run.glob("gwr/*")} for run in (first, second)]
    assert graphs[0] == graphs[1]
    # Weights, optimizer, replay, GWR-B, simulations, random numbers and the tensordict in flight.
    assert_equal(load_checkpoint(first / "checkpoint"), load_checkpoint(second / "checkpoint"))


def at_step(trainer, n, do):
    """Calls `do` in the midst of the n-th step: the simulation has moved, the replay has not."""
    store, steps = trainer.algorithm.store, []

    def store_or_not(transition):
        steps.append(None)
        if len(steps) == n:
            do()
        store(transition)

    trainer.algorithm.store = store_or_not


@every_algorithm
def test_every_seed_plays_every_episode_once(run_of, make_config, name):
    config = make_config(name=name, **of_name(LONGER, name))
    train = rows(run_of(name) / "train.csv")
    seeds = defaultdict(list)
    for row in train:
        seeds[int(row["seed"])].append(row)
    assert set(seeds) == set(config.seeds)
    for played in seeds.values():
        assert [int(row["episode"]) for row in played] == list(range(1, config.episodes + 1))
        total = 0
        for row in played:
            total += int(row["steps"])
            assert int(row["env_steps"]) == total
            assert 1 <= int(row["steps"]) <= config.algorithm.max_steps
            assert int(row["success"]) == float(row["return"])
            assert int(row["success"]) or int(row["steps"]) == config.algorithm.max_steps
            assert 0 <= float(row["intrinsic_return"]) <= 1
            assert (float(row["intrinsic_return"]) > 0) == name.startswith("bgpo")
            assert (int(row["num_nodes"]) > 0) == name.startswith("bgpo")
            assert 0 <= int(row["group"]) < int(row["num_groups"])
    assert {row["success"] for row in train} == {"0", "1"}
    for file in CSV_FILES:
        assert {row["algorithm"] for row in rows(run_of(name) / file)} == {name}
    if name.startswith("bgpo"):
        assert int(train[-1]["num_nodes"]) > 2
    if name not in ("bgpo", "bgpo-experts"):
        assert {row["num_groups"] for row in train} == {"1"}
    assert (float(train[0]["loss_value"]), float(train[-1]["loss_value"]) > 0) == (0, True)


@pytest.mark.parametrize("starts", [(0, 5, 10), (4, 0, 8), (0, 0, 0)])
def test_a_task_is_presented_from_its_start_on(make, make_config, tmp_path, starts):
    config = make_config("state", "oracle", seeds=(0, 1, 2), episodes=16, task_starts=starts)
    make(tmp_path, config).run()
    first = defaultdict(lambda: 99)
    for row in rows(tmp_path / "train.csv"):
        first[row["task"]] = min(first[row["task"]], int(row["episode"]))
    for task, start in zip(TASKS, starts, strict=True):
        assert start < first[task] <= start + 3  # three seeds draw: the next episodes have it
    for row in rows(tmp_path / "eval.csv"):
        assert int(row["episode"]) > starts[TASKS.index(row["task"])]


def test_all_presented_tasks_are_tested_every_few_episodes(make, make_config, tmp_path):
    config = make_config(episodes=5, task_starts=(0, 2, 4), eval_every=2, eval_episodes=3)
    make(tmp_path, config).run()
    tests = rows(tmp_path / "eval.csv")
    counts = Counter((int(row["seed"]), int(row["episode"]), row["task"]) for row in tests)
    tasks_at = {2: TASKS[:1], 4: TASKS[:2]}
    assert counts == {
        (seed, episode, task): 3
        for seed in config.seeds
        for episode, tasks in tasks_at.items()
        for task in tasks
    }
    steps = {
        (row["seed"], row["episode"]): row["env_steps"] for row in rows(tmp_path / "train.csv")
    }
    for row in tests:
        assert row["env_steps"] == steps[row["seed"], row["episode"]]
        assert int(row["success"]) == float(row["return"])


@every_learner
def test_a_seed_writes_what_it_would_write_alone(run_of, make, make_config, tmp_path, name):
    for seed in make_config().seeds:
        config = make_config(name=name, seeds=(seed,), **of_name(LONGER, name))
        make(tmp_path / str(seed), config).run()
        for file in CSV_FILES:
            together = [row for row in rows(run_of(name) / file) if row["seed"] == str(seed)]
            alone = rows(tmp_path / str(seed) / file)
            assert len(together) == len(alone) > 0
            for ours, theirs in zip(together, alone, strict=True):
                intrinsic = [float(row.pop("intrinsic_return", 0)) for row in (ours, theirs)]
                assert intrinsic[0] == pytest.approx(intrinsic[1], rel=1e-3)
                for loss in LOSSES:  # means over the seeds
                    ours.pop(loss, None), theirs.pop(loss, None)
                assert ours == theirs


def test_training_draws_seen_demonstrations_and_tests_held_out_ones(
    make, make_config, bank, tmp_path, monkeypatch
):
    trainer = make(tmp_path, make_config(name="without-gwr", episodes=4))
    store, test = trainer.algorithm.store, trainer.evaluator.run
    trained_on, tested_on = [], []

    def spy_store(transition):
        trained_on.append(transition["behavior"])
        store(transition)

    def spy_test(snapshots, *args):
        tested_on.extend(4 * snapshot.policy.context.flatten(0, 1) for snapshot in snapshots)
        return test(snapshots, *args)

    monkeypatch.setattr(trainer.algorithm, "store", spy_store)
    monkeypatch.setattr(trainer.evaluator, "run", spy_test)
    trainer.run()
    for given, allowed in ((trained_on, bank.seen()), (tested_on, bank.held_out("validation"))):
        rows = torch.cat(given).unique(dim=0)
        assert len(rows) > 3
        assert (rows.unsqueeze(1) == allowed.embedding).all(-1).any(1).all()


@pytest.mark.parametrize("name", ["maml", "dist-nll-demonstrations", "oracle", "ddpg"])
def test_ground_truth_in_place_of_encoders(make, make_config, tmp_path, name):
    make(tmp_path, make_config("state", name, episodes=6), encoders=None).run()
    train = rows(tmp_path / "train.csv")
    assert {(row["num_nodes"], row["intrinsic_return"]) for row in train} == {("0", "0.0")}
    assert {row["success"] for row in train} == {"0", "1"}
    assert all(int(row["success"]) == float(row["return"]) for row in train)


def test_an_algorithm_may_be_made_under_another_name(make, make_config, tmp_path):
    made = []

    def make_it(*args, **kwargs):
        made.append((args, kwargs))
        return ALGORITHMS["ddpg"].make(*args, **kwargs)

    config = make_config("state", "ddpg", episodes=2)
    trainer = make(tmp_path, replace(config, name="no such algorithm"), make=make_it)
    trainer.run()
    ((args, kwargs),) = made
    assert args == (config.algorithm,)
    assert kwargs["seeds"] == config.seeds
    assert trainer.algorithm.variant.context is None
    for file in CSV_FILES:
        assert {row["algorithm"] for row in rows(tmp_path / file)} == {"no such algorithm"}
    with pytest.raises(ValueError, match="no algorithm 'no such algorithm': choose one of bgpo"):
        make(tmp_path / "other", trainer.config)


@pytest.mark.parametrize(
    ("method", "wrong", "said"),
    [
        (
            "make_env",
            lambda *_: None,
            r"^make_env of BGPO must return the simulations \[2\]",
        ),
        ("make_env", lambda env, source: NicoEnv(env.tasks), r"^make_env .* got NicoEnv$"),
        (
            "act",
            lambda td: None,
            "^act of BGPO must return the tensordict with an action, got N",
        ),
        ("act", lambda td: td, "^act of BGPO must return .* with an action, got TensorDict$"),
        ("snapshot", lambda *_: None, r"^snapshot of BGPO must return a Policy .*, got NoneType$"),
        (
            "snapshot",
            lambda *_: Policy(None, "state", {}, torch.zeros(3, 32)),  # pyright: ignore
            r"^the context of a Policy of BGPO must be \[3, 1\] and its features, got \[3, 32\]$",
        ),
    ],
)
def test_what_an_algorithm_must_return_is_said_in_a_line(
    make, make_config, tmp_path, monkeypatch, method, wrong, said
):
    monkeypatch.setattr(BGPO, method, staticmethod(wrong))
    with pytest.raises(TypeError, match=said):
        make(tmp_path, make_config("state", "ddpg", episodes=2)).run()


@pytest.mark.parametrize(("number", "step"), [("SIGINT", 1), ("SIGTERM", 20)])
def test_a_signal_waits_for_the_step_and_the_run_goes_on_from_it(
    uninterrupted, make, tmp_path, number, step
):
    trainer = make(tmp_path)
    at_step(trainer, step, lambda: signal.raise_signal(signal.Signals[number]))
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert load_checkpoint(tmp_path / "checkpoint")["env_steps"] == step
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL

    make(tmp_path, resume=True).run()
    assert_same_run(tmp_path, uninterrupted)
    costs = [read_costs(run / "cost.csv").values() for run in (tmp_path, uninterrupted)]
    ours, theirs = [[(cost.steps, cost.megabytes) for cost in of_run] for of_run in costs]
    assert ours == theirs


@every_learner
def test_a_run_can_be_interrupted_again_and_again(run_of, make, make_config, tmp_path, name):
    config = make_config(name=name, **of_name(LONGER, name))
    steps = (3, 1, 9, 22) if of_name(LONGER, name) else (3, 1, 9)
    for step in steps:
        trainer = make(tmp_path, config, resume=True)
        at_step(trainer, step, lambda: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            trainer.run()
    saved = load_checkpoint(tmp_path / "checkpoint")
    assert saved["env_steps"] == sum(steps)
    assert any(saved["evaluator"]["waiting"])  # snapshots of one seed, for an evaluation of both
    assert saved["algorithm"]["learner"]["optimizer"]["state"]  # it has begun to learn
    if name == "dist-nll":
        assert all(saved["algorithm"]["tasks"])
        assert saved["algorithm"]["ended"].any()  # the next update is to distill
    make(tmp_path, config, resume=True).run()
    assert_same_run(tmp_path, run_of(name))


def crash(*args, **kwargs):
    raise RuntimeError("the lights went out")


MOMENTS = {
    "before the simulation moves": ("algorithm", "act"),
    "while the networks are updated": ("algorithm", "update"),
    "before the transition is stored": ("algorithm", "store"),
    "while an episode is logged": ("logger", "log_train"),
    "while a snapshot is taken": ("evaluator", "take"),
    "while a test is played": ("evaluator", "run"),
    "while a test is logged": ("logger", "log_eval"),
}


@pytest.mark.parametrize(
    ("moment", "saved"),
    [*((moment, 11) for moment in MOMENTS), ("while the networks are updated", 0)],
)
def test_a_run_that_dies_goes_on_from_its_last_checkpoint(
    uninterrupted, make, tmp_path, monkeypatch, moment, saved
):
    """It dies some steps after the checkpoint, and its rows are written again."""
    trainer = make(tmp_path)
    trainer.config = replace(trainer.config, checkpoint_minutes=0.0)
    part, method = MOMENTS[moment]
    alive, save = getattr(getattr(trainer, part), method), trainer.save

    def live_or_die(*args):
        return crash() if trainer.env_steps >= 20 else alive(*args)

    monkeypatch.setattr(getattr(trainer, part), method, live_or_die)
    monkeypatch.setattr(trainer, "save", lambda: trainer.env_steps == saved and save())
    with pytest.raises(RuntimeError, match="the lights went out"):
        trainer.run()

    state = load_checkpoint(tmp_path / "checkpoint")
    assert state["env_steps"] == saved
    assert state["position"]["train.csv"] < (tmp_path / "train.csv").stat().st_size
    make(tmp_path, resume=True).run()
    assert_same_run(tmp_path, uninterrupted)


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_the_run_at_once(make, tmp_path, first):
    trainer = make(tmp_path)

    def impatient():
        signal.raise_signal(first)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("went on after the second interrupt")

    at_step(trainer, 3, impatient)
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert load_checkpoint(tmp_path / "checkpoint")["env_steps"] == 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_that_is_ignored_stays_so(make, make_config, tmp_path):
    trainer = make(tmp_path, make_config(episodes=2))
    at_step(trainer, 1, lambda: signal.raise_signal(signal.SIGINT))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        trainer.run()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(rows(tmp_path / "train.csv")) == 4


def test_checkpoints_are_written_as_often_as_asked(make, make_config, tmp_path):
    trainer = make(tmp_path, make_config(episodes=2, checkpoint_minutes=0.0))
    trainer.run()
    numbers = [path.name.split("-")[1] for path in (tmp_path / "checkpoint").glob("*.pt")]
    assert max(int(number) for number in numbers) == 1 + trainer.env_steps  # one before the first


@pytest.mark.parametrize(
    ("settings", "tests"),
    [
        ({"eval_every": 99}, ""),
        ({"eval_every": 2}, r", in tests( [01]\.\d\d){3}"),
        ({"eval_every": 2, "task_starts": (0, 2, 99)}, r", in tests( [01]\.\d\d){2} -"),
    ],
)
def test_the_progress_bar_tells_the_success_so_far(
    make, make_config, tmp_path, capsys, settings, tests
):
    make(tmp_path, make_config(**settings), progress=True).run()
    won = [int(row["success"]) for row in rows(tmp_path / "train.csv")]
    last = capsys.readouterr().err.split("\r")[-1]
    expected = rf"train: 100%\|.*\| 20/20 .*, success {sum(won) / len(won):.2f}{tests}\]\n"
    assert re.fullmatch(expected, last)


def test_a_finished_run_is_left_as_it_is(uninterrupted, make):
    before = contents(uninterrupted)
    with make(uninterrupted, resume=True) as trainer:
        trainer.algorithm.act = crash
        trainer.run()
    assert contents(uninterrupted) == before
    assert trainer.env_steps == load_checkpoint(uninterrupted / "checkpoint")["env_steps"]


def test_a_directory_with_another_run_is_refused(uninterrupted, make, make_config):
    with pytest.raises(ValueError, match="already holds a run: resume it"):
        make(uninterrupted)
    shorter, later = make_config(episodes=9), make_config(task_starts=(0, 2, 5))
    for config in (shorter, later, make_config(seeds=(1, 2)), make_config(name="ddpg")):
        with pytest.raises(ValueError, match="holds a run with other settings"):
            make(uninterrupted, config, resume=True)


def test_a_run_with_other_encoders_is_another_run(uninterrupted, make, encoders):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        other = replace(encoders, lae=SequenceAutoencoder())
    with pytest.raises(ValueError, match=r"other settings \(encoders is [0-9a-f]+ there and"):
        make(uninterrupted, encoders=other, resume=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": ()}, "seeds must be one or more, all different"),
        ({"seeds": (1, 1)}, "seeds must be one or more, all different"),
        ({"seeds": (-1,)}, "none negative"),
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
        ({"eval_every": 0}, "eval_every must be at least 1, got 0"),
        ({"eval_episodes": -2}, "eval_episodes must be at least 1, got -2"),
    ],
)
def test_runs_that_cannot_be_are_refused(make_config, changes, message):
    with pytest.raises(ValueError, match=message):
        make_config(**changes)


def test_steps_are_counted_by_the_number_of_tasks_that_all_seeds_have(uninterrupted):
    train, costs = rows(uninterrupted / "train.csv"), read_costs(uninterrupted / "cost.csv")
    ends = [
        max(int(row["env_steps"]) for row in train if int(row["episode"]) == end)
        for end in (2, 4, 10)  # the tasks start at 0, 2 and 4
    ]
    assert list(costs) == [1, 2, 3]
    assert list(itertools.accumulate(cost.steps for cost in costs.values())) == ends
    sizes = [cost.megabytes for cost in costs.values()]
    assert 0 < sizes[0] < sizes[1] < sizes[2]  # the replay grows
    state = load_checkpoint(uninterrupted / "checkpoint")["algorithm"]
    assert sizes[2] == pytest.approx(n_bytes(state) / 1e6, abs=1e-6)


def test_without_practice_only_the_newest_task_is_trained_and_all_are_tested(
    make, make_config, tmp_path
):
    make(tmp_path, make_config(schedule="sequential")).run()
    tasks = make_config().tasks
    played = {(int(row["episode"]), row["task"]) for row in rows(tmp_path / "train.csv")}
    newest = [tasks[(episode > 2) + (episode > 4)] for episode in range(1, 11)]
    assert played == {*enumerate(newest, 1)}
    tested = {(int(row["episode"]), row["task"]) for row in rows(tmp_path / "eval.csv")}
    assert {task for episode, task in tested if episode == 10} == {*tasks}
    assert list(read_costs(tmp_path / "cost.csv")) == [1, 2, 3]


def test_the_time_of_a_step_is_that_of_training_without_tests_and_checkpoints(
    make, make_config, tmp_path, monkeypatch
):
    clock = [0.0]
    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    trainer = make(tmp_path, make_config(episodes=4, checkpoint_minutes=0.0))

    def taking(seconds, function):
        def call(*arguments):
            clock[0] += seconds
            return function(*arguments)

        return call

    for owner, method, seconds in (
        (trainer.algorithm, "act", 0.25),
        (trainer.evaluator, "run_next", 100.0),
        (trainer, "save", 100.0),
    ):
        monkeypatch.setattr(owner, method, taking(seconds, getattr(owner, method)))
    trainer.run()
    costs = read_costs(tmp_path / "cost.csv")
    assert sum(cost.steps for cost in costs.values()) == trainer.env_steps
    assert all(cost.seconds == 0.25 * cost.steps for cost in costs.values())


def test_a_bank_that_cannot_be_kept_leaves_nothing_open(make, tmp_path, monkeypatch):
    def refuse(*args):
        raise OSError("cannot write the bank: make room")

    closed = []
    close = training.RunLogger.close
    monkeypatch.setattr(training.RunLogger, "close", lambda log: (closed.append(1), close(log)))
    monkeypatch.setattr(training, "keep_bank", refuse)
    with pytest.raises(OSError, match="make room"):
        make(tmp_path / "run")
    assert closed == [1]
    assert not (tmp_path / "run" / "lock").exists()


def test_encoders_and_a_bank_of_other_encoders_are_refused(make_config, encoders, bank, tmp_path):
    foreign = replace(bank, encoder_id="of others")
    with pytest.raises(ValueError, match=r"embedded by the encoders of others, these are .* anew"):
        Trainer(make_config(), tmp_path / "run", bank=foreign, encoders=encoders)
    assert not (tmp_path / "run").exists()
