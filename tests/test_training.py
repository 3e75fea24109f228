"""Whole runs, small ones: what they write, and that no interrupt changes it."""

import itertools
import signal
import warnings
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torchrl.envs import RewardScaling, TransformedEnv

from bgpo_trl import training
from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.runs.cost import n_bytes
from bgpo_trl.runs.results import read_table
from bgpo_trl.scenes.nico import NicoEnv, NicoSimulation
from tests.algorithms.playing import assert_same
from tests.conftest import of_name
from tests.helpers import DISTINCT, Recorder, at_step, contents, finish, interrupt, rows, spied

pytestmark = pytest.mark.usefixtures("easy_world")
CSV_FILES = ("train.csv", "eval.csv")
TASKS = ("grasp_glass", "push_green_to_glass", "push_green_to_white")
ROUNDED = ("intrinsic_return", "loss_actor", "loss_value")
# Algorithms that need data of each task begin to learn later.
LONGER = {"maml": {"episodes": 16}, "dist-nll": {"episodes": 16}}


@pytest.fixture(scope="module")
def config_of(make_config):
    return lambda name, **changes: make_config(name=name, **of_name(LONGER, name), **changes)


@pytest.fixture(scope="module")
def run_of(begin, config_of, easy_world, tmp_path_factory):
    """Play a run of each algorithm once."""
    directories = {}

    def run_of(name):
        if name not in directories:
            directories[name] = tmp_path_factory.mktemp(name)
            begin(directories[name], config_of(name)).run()
        return directories[name]

    return run_of


@pytest.fixture(scope="module")
def uninterrupted(run_of):
    return run_of("bgpo")


def assert_same_run(first, second):
    for name in CSV_FILES:
        # Line by line: pytest would take minutes to show where long byte strings differ.
        lines = [(run / name).read_text().splitlines() for run in (first, second)]
        assert lines[0] == lines[1]
    # Weights, optimizer, replay, GWR-B, simulations, random numbers and the tensordict in flight.
    assert_same(load_checkpoint(first / "checkpoint"), load_checkpoint(second / "checkpoint"))


@pytest.mark.parametrize("name", DISTINCT)
def test_every_seed_plays_every_episode_once(run_of, config_of, name):
    config = config_of(name)
    train = rows(run_of(name) / "train.csv")
    assert {int(row["seed"]) for row in train} == {*config.seeds}
    with_gwr = getattr(config.algorithm, "context", None) == "behavior"
    for seed in config.seeds:
        played = [row for row in train if row["seed"] == str(seed)]
        assert [int(row["episode"]) for row in played] == list(range(1, config.episodes + 1))
        lengths = [int(row["steps"]) for row in played]
        assert [int(row["env_steps"]) for row in played] == [*itertools.accumulate(lengths)]
        for row, length in zip(played, lengths, strict=True):
            assert 1 <= length <= config.algorithm.max_steps
            assert int(row["success"]) == float(row["return"])
            assert int(row["success"]) or length == config.algorithm.max_steps
            assert 0 <= float(row["intrinsic_return"]) <= 1
            assert (float(row["intrinsic_return"]) > 0) == with_gwr
            assert (int(row["num_nodes"]) > 0) == with_gwr
            assert 0 <= int(row["group"]) < int(row["num_groups"])
    assert {row["success"] for row in train} == {"0", "1"}
    for file in CSV_FILES:
        for row in rows(run_of(name) / file):
            assert row["algorithm"] == name
            assert int(row["episode"]) > config.task_starts[TASKS.index(row["task"])]
    if name.startswith("bgpo"):
        assert int(train[-1]["num_nodes"]) > 2
    assert (float(train[0]["loss_value"]), float(train[-1]["loss_value"]) > 0) == (0, True)


def test_all_presented_tasks_are_tested_every_few_episodes(begin, make_config, tmp_path):
    config = make_config("state", "oracle", episodes=5, eval_every=2, eval_episodes=3)
    begin(tmp_path, config).run()
    tests = rows(tmp_path / "eval.csv")
    counts = Counter((int(row["seed"]), int(row["episode"]), row["task"]) for row in tests)
    due = [(2, TASKS[0]), (4, TASKS[0]), (4, TASKS[1])]
    assert counts == {(seed, *test): 3 for seed in config.seeds for test in due}
    train = rows(tmp_path / "train.csv")
    steps = {(row["seed"], row["episode"]): row["env_steps"] for row in train}
    for row in tests:
        assert row["env_steps"] == steps[row["seed"], row["episode"]]
        assert int(row["success"]) == float(row["return"])


@pytest.mark.parametrize(("name", "seed"), zip(DISTINCT, itertools.cycle((3, 8)), strict=False))
def test_rows_of_a_seed_equal_those_of_the_seed_alone(
    run_of, begin, config_of, tmp_path, name, seed
):
    begin(tmp_path, config_of(name, seeds=(seed,))).run()
    for file in CSV_FILES:
        together = [row for row in rows(run_of(name) / file) if row["seed"] == str(seed)]
        alone = rows(tmp_path / file)
        assert len(together) == len(alone) > 0
        for ours, theirs in zip(together, alone, strict=True):
            for key in ROUNDED:
                pair = [float(row.pop(key, 0)) for row in (ours, theirs)]
                assert pair[0] == pytest.approx(pair[1], rel=1e-3, abs=1e-5)
            assert ours == theirs


def test_training_draws_seen_demonstrations_and_tests_held_out_ones(
    begin, make_config, bank, tmp_path
):
    trainer = begin(tmp_path, make_config(name="without-gwr", episodes=4))
    stored, tested = spied(trainer.algorithm, "store"), spied(trainer.evaluator, "run")
    trainer.run()
    trained_on = [transition["behavior"] for (transition,), _ in stored]
    contexts = [one.policy.context for (snapshots, *_), _ in tested for one in snapshots]
    tested_on = [4 * context.flatten(0, 1) for context in contexts]
    for given, allowed in ((trained_on, bank.seen()), (tested_on, bank.held_out("validation"))):
        shown = torch.cat(given).unique(dim=0)
        assert len(shown) > 3
        assert (shown.unsqueeze(1) == allowed.embedding).all(-1).any(1).all()


class WithEntropy(BGPO):
    """An algorithm of a user that logs the number of its updates and what it never returns."""

    logged = ("loss_entropy", "loss_missing")
    n_updates = 0

    def update(self):
        losses = super().update()
        self.n_updates += bool(losses)
        return losses and {**losses, "loss_entropy": torch.tensor(float(self.n_updates))}


def test_an_algorithm_may_log_further_losses(uninterrupted, begin, tmp_path):
    recorder = Recorder()
    trainer = finish(begin(tmp_path, make=WithEntropy, loggers=[recorder]))
    ours, usual = rows(tmp_path / "train.csv"), rows(uninterrupted / "train.csv")
    assert [list(row)[-2:] for row in ours[:1]] == [["loss_entropy", "loss_missing"]]
    logged = [(float(row.pop("loss_entropy")), row.pop("loss_missing")) for row in ours]
    assert ours == usual
    assert logged[0] == (0.0, "0.0")  # before the first update
    assert [n for n, _ in logged] == sorted(n for n, _ in logged)
    assert logged[-1][0] == trainer.algorithm.n_updates > 0
    played = [n for row, (n, _) in zip(ours, logged, strict=True) if int(row["episode"]) > 8]
    assert recorder.metrics[-1][0]["train/loss_entropy"] == pytest.approx(sum(played) / len(played))
    with pytest.raises(ValueError, match="columns"):
        begin(tmp_path, resume=True)


def test_an_update_follows_every_so_many_steps(begin, make_config, tmp_path):
    config = make_config("state", "ddpg", rl={"update_every": 3}, episodes=4)
    calls = []

    class Counted(BGPO):
        def update(self):
            calls.append(len(self.replay))
            return super().update()

    trainer = finish(begin(tmp_path, config, make=Counted))
    assert calls == [*range(0, trainer.env_steps, 3)]  # transitions stored before


def test_a_run_extended_in_steps_equals_a_longer_run(begin, make_config, tmp_path):
    """Seeds that were done early have gone on; nothing of that is lost, nor on a dashboard."""
    run, straight = tmp_path / "longer", tmp_path / "straight"
    config, whole, parts = make_config(episodes=16), Recorder(), [Recorder(), Recorder()]
    finish(begin(straight, config, loggers=[whole]))
    for episodes in (12, 13):
        part = replace(config, episodes=episodes, checkpoint_minutes=float(episodes))
        finish(begin(run, part, resume=True))
        played = sorted((row["seed"], int(row["episode"])) for row in rows(run / "train.csv"))
        assert played == [(seed, n + 1) for seed in "38" for n in range(episodes)]
        assert load_checkpoint(run / "checkpoint")["later"]
    interrupt(begin(run, config, resume=True, loggers=parts[:1]), 1)
    finish(begin(run, config, resume=True, loggers=parts[1:]))
    assert [step for part in parts for _, step in part.metrics] == [14, 16]
    assert parts[0].metrics + parts[1].metrics == whole.metrics[-2:]
    for file in CSV_FILES:
        # Episodes that were played early are logged late.
        lines = [sorted((folder / file).read_text().splitlines()) for folder in (run, straight)]
        assert lines[0] == lines[1]
    assert (run / "config.json").read_text() == (straight / "config.json").read_text()
    assert_same(*(load_checkpoint(folder / "checkpoint") for folder in (run, straight)))


@pytest.mark.parametrize(
    ("method", "wrong"),
    [
        ("make_env", lambda *_: None),
        ("make_env", lambda env, source: NicoEnv(env.tasks)),
        ("act", lambda td: None),
        ("act", lambda td: td),
        ("snapshot", lambda *_: None),
        ("snapshot", lambda *_: Policy(None, "state", {}, torch.zeros(3, 32))),  # pyright: ignore
    ],
)
def test_wrong_results_of_an_algorithm_are_refused(
    begin, make_config, tmp_path, monkeypatch, method, wrong
):
    monkeypatch.setattr(BGPO, method, staticmethod(wrong))
    with pytest.raises(TypeError, match=r"BGPO must (return|be)"):
        begin(tmp_path, make_config("state", "ddpg", episodes=2)).run()


def test_returns_that_clipped_values_cannot_reach_are_refused(
    begin, make_config, tmp_path, monkeypatch
):
    config = make_config("state", "ddpg", episodes=2)
    make_env = BGPO.make_env

    def costly(self, env, source):
        return make_env(self, TransformedEnv(env, RewardScaling(-1.0, 1.0)), source)

    monkeypatch.setattr(BGPO, "make_env", costly)
    with pytest.raises(ValueError, match=r"an episode of .* has a return of -\d+, but values"):
        begin(tmp_path / "clipped", config).run()
    rl = replace(config.algorithm.rl, clip_targets=False)
    finish(begin(tmp_path / "free", replace(config, algorithm=replace(config.algorithm, rl=rl))))
    assert min(float(row["return"]) for row in rows(tmp_path / "free" / "train.csv")) < -1


@pytest.mark.parametrize("name", [*DISTINCT, "clone"])
def test_a_run_interrupted_several_times_is_the_same(run_of, begin, config_of, tmp_path, name):
    """A signal waits for the end of the step; also if loggers are added to the resumed run."""
    config = config_of(name)
    steps = (1, 12, 23) if of_name(LONGER, name) else (1, 16)
    for step, number in zip(steps, itertools.cycle((signal.SIGINT, signal.SIGTERM)), strict=False):
        interrupt(begin(tmp_path, config, resume=True), step, number)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    saved = load_checkpoint(tmp_path / "checkpoint")
    assert saved["env_steps"] == sum(steps)
    assert any(saved["evaluator"]["waiting"])  # snapshots of one seed, for an evaluation of both
    assert saved["algorithm"]["learner"]["optimizer"]["state"]  # it has begun to learn
    if name.startswith("dist-nll"):
        assert all(saved["algorithm"]["tasks"])
        assert saved["algorithm"]["ended"].any()  # the next update is to distill
    if name.startswith("ewc"):
        assert max(saved["algorithm"]["replay"]["n_added"]) < sum(steps)  # emptied at a boundary
    recorder = Recorder()
    finish(begin(tmp_path, config, resume=True, loggers=[recorder]))
    assert recorder.metrics[-1][1] == config.episodes
    assert_same_run(tmp_path, run_of(name))
    ours, theirs = (read_table(run / "cost.csv") for run in (tmp_path, run_of(name)))
    assert ours.drop(columns="seconds").equals(theirs.drop(columns="seconds"))


def crash(*args, **kwargs):
    raise RuntimeError("a failure")


@pytest.mark.parametrize(
    ("part", "name", "saved"),
    [
        (lambda trainer: trainer.algorithm, "act", 11),
        (lambda trainer: trainer.algorithm, "update", 0),
        (lambda trainer: trainer.evaluator, "take", 11),
        (lambda trainer: trainer.tables["eval.csv"], "write", 11),
    ],
)
def test_a_run_that_fails_is_resumed_from_its_last_checkpoint(
    uninterrupted, begin, tmp_path, monkeypatch, part, name, saved
):
    """Rows written after the checkpoint are written again."""
    trainer = begin(tmp_path)
    trainer.config = replace(trainer.config, checkpoint_minutes=0.0)
    owner, save = part(trainer), trainer.save
    intact = getattr(owner, name)

    def failing(*args):
        return crash() if trainer.env_steps >= 20 else intact(*args)

    monkeypatch.setattr(owner, name, failing)
    monkeypatch.setattr(trainer, "save", lambda: trainer.env_steps == saved and save())
    with pytest.raises(RuntimeError, match="a failure"):
        trainer.run()

    state = load_checkpoint(tmp_path / "checkpoint")
    assert state["env_steps"] == saved
    assert state["position"]["train.csv"] < (tmp_path / "train.csv").stat().st_size
    begin(tmp_path, resume=True).run()
    assert_same_run(tmp_path, uninterrupted)


@pytest.mark.parametrize("last", ["", "cost.csv", "checkpoint"])
def test_costs_are_those_of_the_checkpoint_after_kills_while_both_are_written(
    begin, make_config, tmp_path, monkeypatch, last
):
    """Killed before or after ``last`` was written, twice."""
    config = make_config("state", "ddpg", episodes=4)
    interrupt(begin(tmp_path, config), 7)

    def save_and_crash(*args):
        save_checkpoint(*args)
        crash()

    def steps():
        return read_table(tmp_path / "cost.csv")["steps"].sum()

    for killed in (1, 2):
        with monkeypatch.context() as patch:
            if not last:
                patch.setattr(training.CostLog, "write", crash)
            patch.setattr(
                training, "save_checkpoint", save_and_crash if last == "checkpoint" else crash
            )
            with pytest.raises(RuntimeError, match="a failure"):
                interrupt(begin(tmp_path, config, resume=True), 4)
        with begin(tmp_path, config, resume=True) as trainer:
            assert trainer.env_steps == 7 + 4 * killed * (last == "checkpoint")
            assert steps() == trainer.env_steps
    trainer = finish(begin(tmp_path, config, resume=True))
    assert steps() == trainer.env_steps
    assert not (tmp_path / "checkpoint" / "cost.csv").exists()


def test_a_second_signal_ends_the_run_at_once(begin, make_config, tmp_path):
    trainer = begin(tmp_path, make_config("state", "ddpg"))

    def impatient():
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("went on after the second interrupt")

    at_step(trainer, 3, impatient)
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert load_checkpoint(tmp_path / "checkpoint")["env_steps"] == 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_ignored_interrupt_stays_ignored(begin, make_config, tmp_path):
    trainer = begin(tmp_path, make_config("state", "ddpg", episodes=2))
    at_step(trainer, 1, lambda: signal.raise_signal(signal.SIGINT))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        trainer.run()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(rows(tmp_path / "train.csv")) == 4


def test_resuming_a_finished_run_changes_nothing(uninterrupted, begin):
    before = contents(uninterrupted)
    with begin(uninterrupted, resume=True) as trainer:
        trainer.algorithm.act = crash
        trainer.run()
    assert contents(uninterrupted) == before
    assert trainer.env_steps == load_checkpoint(uninterrupted / "checkpoint")["env_steps"]


def test_costs_are_counted_by_the_number_of_presented_tasks(uninterrupted):
    train, costs = rows(uninterrupted / "train.csv"), read_table(uninterrupted / "cost.csv")
    ends = [
        max(int(row["env_steps"]) for row in train if int(row["episode"]) == end)
        for end in (2, 4, 10)  # the tasks start at 0, 2 and 4
    ]
    assert costs["tasks"].tolist() == [1, 2, 3]
    assert costs["steps"].cumsum().tolist() == ends
    sizes = costs["megabytes"].tolist()
    assert 0 < sizes[0] < sizes[1] < sizes[2]  # the replay grows
    state = load_checkpoint(uninterrupted / "checkpoint")["algorithm"]
    assert sizes[2] == pytest.approx(n_bytes(state) / 1e6, abs=1e-6)


def test_checkpoints_are_written_when_due_and_like_tests_are_not_in_step_times(
    begin, make_config, tmp_path, monkeypatch
):
    clock = [0.0]
    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    config = make_config("state", "ddpg", episodes=4, checkpoint_minutes=1.0)
    trainer = begin(tmp_path, config)

    def taking(seconds, function):
        def call(*arguments):
            clock[0] += seconds
            return function(*arguments)

        return call

    for owner, method, seconds in (
        (trainer.algorithm, "act", 0.25),
        (trainer.evaluator, "run", 100.0),
        (trainer, "save", 100.0),
    ):
        monkeypatch.setattr(owner, method, taking(seconds, getattr(owner, method)))
    trainer.run()
    costs = read_table(tmp_path / "cost.csv")
    assert costs["steps"].sum() == trainer.env_steps
    assert (costs["seconds"] == 0.25 * costs["steps"]).all()
    numbers = [path.stem.split("-")[1] for path in (tmp_path / "checkpoint").glob("*.pt")]
    # Before the first step, after the tests of episode 2, and after those of 4, at the end.
    assert max(int(number) for number in numbers) == 3


def test_the_sequential_schedule_trains_the_newest_task_and_tests_all(begin, make_config, tmp_path):
    begin(tmp_path, make_config("state", "ddpg", schedule="sequential")).run()
    tasks = make_config().tasks
    played = {(int(row["episode"]), row["task"]) for row in rows(tmp_path / "train.csv")}
    newest = [tasks[(episode > 2) + (episode > 4)] for episode in range(1, 11)]
    assert played == {*enumerate(newest, 1)}
    tested = {(int(row["episode"]), row["task"]) for row in rows(tmp_path / "eval.csv")}
    assert {task for episode, task in tested if episode == 10} == {*tasks}
    assert read_table(tmp_path / "cost.csv")["tasks"].tolist() == [1, 2, 3]


class Attentive(BGPO):
    """DDPG that notes the tasks that begin and those that it plays, for each seed."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.notes = [[] for _ in range(self.n_seeds)]

    def begin_task(self, index, task):
        self.notes[index].append(("begin", task))

    def store(self, transition):
        super().store(transition)
        for index in transition["next", "done"].flatten().nonzero().flatten().tolist():
            self.notes[index].append(("played", int(transition["task"][index])))

    def state_dict(self):
        return {**super().state_dict(), "notes": self.notes}

    def load_state_dict(self, state):
        super().load_state_dict(state)
        self.notes = state["notes"]


def test_tasks_begin_for_each_seed_before_they_are_played(begin, make_config, tmp_path):
    """Once each, also if the run is interrupted around the boundary of either seed."""
    config = make_config("state", "ddpg", task_starts=(3, 0, 3), schedule="sequential")
    config = replace(config, name="attentive", episodes=6)
    parts = {"make": Attentive, "resume": True}
    whole = finish(begin(tmp_path / "whole", config, **parts))
    played = rows(tmp_path / "whole" / "train.csv")
    ends = [int(row["env_steps"]) for row in played if row["episode"] == "3"]
    assert ends[0] != ends[1]
    for step in sorted({end - before for end in ends for before in (0, 1)}):
        trainer = begin(tmp_path / "run", config, **parts)
        interrupt(trainer, step - trainer.env_steps)
    resumed = finish(begin(tmp_path / "run", config, **parts))
    for trainer in (whole, resumed):
        for notes in trainer.algorithm.notes:
            assert notes[:5] == [*[("played", 1)] * 3, ("begin", 0), ("begin", 2)]
            assert {kind for kind, _ in notes[5:]} == {"played"}
            assert {task for _, task in notes[5:]} <= {0, 2}


def test_a_bank_of_other_encoders_is_refused(begin, bank, tmp_path, refused):
    other = replace(bank, encoder_id="of others")
    refused(lambda: begin(tmp_path / "run", bank=other), "of others", "load both together")


def test_a_failure_to_write_the_bank_closes_the_run(begin, tmp_path, monkeypatch):
    def refuse(*args):
        raise OSError("cannot write the bank: make room")

    closed = []
    close = CsvFile.close
    monkeypatch.setattr(CsvFile, "close", lambda table: (closed.append(table.path), close(table)))
    monkeypatch.setattr(training, "keep_inputs", refuse)
    with pytest.raises(OSError, match="make room"):
        begin(tmp_path / "run")
    assert sorted(path.name for path in closed) == ["eval.csv", "train.csv"]
    assert not (tmp_path / "run" / "lock").exists()


@pytest.mark.parametrize("turned", [False, True])
def test_frames_unlike_those_that_the_encoders_know_are_warned_of(
    begin, make_config, tmp_path, monkeypatch, turned
):
    encoders, bank = load_pretrained()
    if turned:
        frame = NicoSimulation.frame
        monkeypatch.setattr(NicoSimulation, "frame", lambda self: frame(self)[..., ::-1])
    config = make_config(episodes=2, task_starts=(0, 0, 0))
    with (
        warnings.catch_warnings(record=True) as caught,
        begin(tmp_path, config, encoders=encoders, bank=bank) as trainer,
    ):
        trainer.run()
    known = "the simulation's frames fit the encoders better with red and blue exchanged: "
    assert [str(one.message).startswith(known) for one in caught] == [True] * turned
