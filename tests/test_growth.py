"""A further task for a run that has begun: nothing learned before changes."""

import copy
import shutil
from dataclasses import replace
from functools import partial

import pytest
import torch

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.runs.config_file import read_config
from bgpo_trl.runs.growth import add_task, distinctness
from bgpo_trl.training import Trainer
from tests.helpers import finish, interrupt, rows
from tests.test_training import assert_same, assert_same_run

pytestmark = pytest.mark.usefixtures("easy_world")
NEW = "lift_green"


@pytest.fixture(scope="module")
def further(bank, encoders, tmp_path_factory):
    """A file with demonstrations of a fourth task, which lie apart from the others."""
    path = tmp_path_factory.mktemp("further") / "bank.safetensors"
    shown = replace(bank.for_tasks(bank.tasks[2:]), tasks=(NEW,), encoder_id=encoders.identity)
    shown = replace(shown, embedding=shown.embedding - 4.0, scene=encoders.metadata["scene"])
    shown.save(path)
    return path


@pytest.fixture(scope="module")
def three(begin, make_config, tmp_path_factory):
    """A finished run of three tasks, whose seeds are not in step."""
    directory = tmp_path_factory.mktemp("three")
    finish(begin(directory, make_config(eval_every=3)))
    return directory


@pytest.fixture
def grow(three, further, tmp_path):
    """Copy the run and return what it goes on with, to so many episodes."""

    def make(name, episodes=36):
        run = tmp_path / name
        shutil.copytree(three, run)
        config = replace(read_config(run / "config.json")[0], episodes=episodes)
        return run, add_task(run, NEW, config=config, bank=further)

    return make


def resumed(run, grown, **arguments):
    parts = {"bank": grown.bank, "encoders": grown.encoders, **arguments}
    return Trainer(grown.config, run, resume=True, progress=False, **parts)


def test_nothing_that_was_learned_changes_when_a_task_is_added(grow, three):
    run, grown = grow("run")
    with resumed(run, grown) as trainer:
        trainer.save()
    before, after = load_checkpoint(three / "checkpoint"), load_checkpoint(run / "checkpoint")
    *known, new = after["world"]["simulation"].pop("tasks")
    assert (*known,) == before["world"]["simulation"].pop("tasks")
    assert new == NEW
    for part in ("algorithm", "world", "state", "env_steps", "losses"):
        assert_same(before[part], after[part])
    config, _ = read_config(run / "config.json")
    assert config.tasks == (*read_config(three / "config.json")[0].tasks, NEW)
    assert config.task_starts == (0, 2, 4, int(before["world"]["source"]["episode"].max()) + 1)


def test_the_added_task_is_played_and_tested_from_its_start_and_rows_before_stay(grow, three):
    run, grown = grow("run")
    finish(resumed(run, grown))
    start = grown.config.task_starts[-1]
    played = [int(row["episode"]) for row in rows(run / "train.csv") if row["task"] == NEW]
    tested = {int(row["episode"]) for row in rows(run / "eval.csv") if row["task"] == NEW}
    assert start < min(played)
    assert tested == {e for e in range(3, 37, 3) if e > start}
    for name in ("train.csv", "eval.csv"):
        before = (three / name).read_text()
        assert (run / name).read_text().startswith(before)


def test_a_run_that_is_interrupted_after_the_addition_equals_one_that_is_not(grow, encoders):
    straight, grown = grow("straight")
    finish(resumed(straight, grown))
    run, grown = grow("interrupted")
    resumed(run, grown).close()  # as if killed before its first checkpoint
    config = read_config(run / "config.json")[0]
    for step in (3, 20):
        interrupt(resumed(run, grown._replace(config=config)), step)
    bank = DemonstrationBank.load(run / "bank.safetensors", encoder_id=encoders.identity)
    finish(resumed(run, grown, bank=bank))
    assert_same_run(run, straight)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("juggle", "no task 'juggle'"),
        ("grasp_glass", "has the task 'grasp_glass' already"),
        ("press_white", "no demonstration of 'press_white'"),
        (NEW, "would end after 10 episodes"),
    ],
)
def test_a_task_that_cannot_be_added_is_refused(three, further, tmp_path, refused, task, message):
    run = tmp_path / "run"
    shutil.copytree(three, run)
    refused(lambda: add_task(run, task, bank=further), message, "")


@pytest.mark.parametrize("name", ["oracle-demonstrations", "dist-nll-demonstrations"])
def test_algorithms_with_a_fixed_number_of_tasks_take_no_further_one(
    begin, make_config, further, tmp_path, refused, name
):
    run = tmp_path / "run"
    finish(begin(run, make_config(name=name, episodes=5)))
    config = replace(read_config(run / "config.json")[0], episodes=20)
    grown = add_task(run, NEW, config=config, bank=further)
    refused(lambda: resumed(run, grown), "cannot take another one", "new run with all")


def test_a_task_does_not_start_in_an_episode_that_was_played_without_it(grow, refused):
    run, grown = grow("run")
    early = replace(grown.config, task_starts=(0, 2, 4, 6))
    refused(lambda: resumed(run, grown._replace(config=early)), "without the new task", "let it")


def test_demonstrations_of_earlier_tasks_must_stay(grow, bank, refused):
    run, grown = grow("run")
    changed = copy.deepcopy(grown.bank)
    changed.embedding[0] += 1
    first = grown.bank.for_tasks((NEW,)) + grown.bank.for_tasks(bank.tasks)
    for other in (changed, first):
        begin = partial(resumed, run, grown, bank=other)
        refused(begin, "must stay the same", "add_task")


def test_encoders_that_confuse_the_new_task_are_reported():
    place = torch.tensor([0.0, 0.1, 0.25, 5.0, 5.1, 5.25])
    task = torch.arange(6) // 3
    for new, clear, share in (([9.0, 9.1, 9.25], True, 1.0), ([5.01, 5.11, 5.26], False, 0.0)):
        embedding = torch.cat([place, torch.tensor(new)]).unsqueeze(1)
        label = torch.cat([task, torch.full((3,), 2)])
        bank = DemonstrationBank(embedding, label, torch.ones(9, dtype=torch.bool), ("a", "b", "c"))
        told_apart, line = distinctness(bank)
        assert told_apart == clear
        assert f"{share:.0%} of the new demonstrations, 100% of the old; the encoders" in line
        assert ("confuse the new task with b" in line) != clear
