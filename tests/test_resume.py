"""Runs that are killed or run out of disk space end as if uninterrupted."""

import multiprocessing
import time
from contextlib import ExitStack
from functools import partial

import numpy as np
import pytest
import torch

from bgpo_trl.data.dataset import load_demonstrations
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.files.checkpoint import load_checkpoint
from tests.helpers import at_step, largest_file
from tests.resumable import play, train_small_encoders
from tests.test_training import assert_same_run

pytestmark = pytest.mark.usefixtures("easy_world")
often = pytest.mark.parametrize("times", [2, pytest.param(10, marks=pytest.mark.slow)])


def kill_again_and_again(target, arguments, progress, times):
    """Start `target` in a process and kill it at random moments; then let it end.

    Each process is killed a random moment after some progress, so as late on a slow machine as on a
    fast one. Processes are forks of one that has imported everything and has no window to the GPU.

    Args:
        target: Begins or continues something.
        arguments: Its arguments.
        progress: Returns a number that grows with its progress.
        times: How often it is killed.
    """
    rng = np.random.default_rng(0)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.resumable"])
    reached = []
    for _ in range(times):
        process = context.Process(target=target, args=arguments)
        process.start()
        enough = progress() + int(rng.integers(3))
        while process.is_alive() and progress() < enough:
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.03))
        process.kill()
        process.join()
        assert process.exitcode == -9, "it ended before it was killed"
        reached.append(progress())
    assert reached[0] < reached[-1]
    process = context.Process(target=target, args=arguments)
    process.start()
    process.join()
    assert process.exitcode == 0


def assert_same_encoders(first, second):
    """Compare encoders, bank and log in two folders bit for bit."""
    made = [load_pretrained(folder / "encoders.safetensors") for folder in (first, second)]
    assert made[0][0].identity == made[1][0].identity
    assert made[0][1].embedding.equal(made[1][1].embedding)
    logs = [(folder / "log" / "train.csv").read_text().splitlines() for folder in (first, second)]
    assert logs[0] == logs[1]


@pytest.fixture(scope="module")
def make(easy_world, begin, make_config):
    """Make the trainer of a small run with a checkpoint after each step."""
    return partial(begin, config=make_config("state", "ddpg", checkpoint_minutes=0.0))


@pytest.fixture(scope="module")
def uninterrupted(make, tmp_path_factory):
    directory = tmp_path_factory.mktemp("uninterrupted")
    make(directory).run()
    return directory


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    directory = tmp_path_factory.mktemp("learned")
    train_small_encoders(directory)
    return directory


@often
def test_a_run_killed_several_times_equals_an_uninterrupted_run(
    begin, make_config, bank, encoders, tmp_path, times
):
    config = make_config(episodes=2 * times + 4, checkpoint_minutes=0.0)
    begin(tmp_path / "straight", config).run()
    torch.save((config, bank, encoders), tmp_path / "parts.pt")
    run = tmp_path / "killed"

    def steps():
        names = [path.stem for path in run.glob("checkpoint/checkpoint-*.pt")]
        return max((int(name.split("-")[1]) for name in names), default=0)

    kill_again_and_again(play, (run, tmp_path / "parts.pt"), steps, times)
    assert_same_run(run, tmp_path / "straight")


@often
def test_encoder_training_killed_several_times_gives_the_same_encoders(learned, tmp_path, times):
    def progress():
        recorded, log = tmp_path / "demonstrations" / "length.memmap", tmp_path / "log/train.csv"
        episodes = (np.fromfile(recorded, np.int64) > 0).sum() if recorded.exists() else 0
        return int(episodes) + (log.read_bytes().count(b"\n") if log.exists() else 0)

    kill_again_and_again(train_small_encoders, (tmp_path,), progress, times)
    assert_same_encoders(tmp_path, learned)
    for name in ("demonstrations/dataset.json", "log/probes.json"):
        assert (tmp_path / name).read_text() == (learned / name).read_text()
    load_demonstrations(tmp_path / "demonstrations")  # compares the checksum


@pytest.mark.parametrize("full", ["checkpoint", "train.csv"])
def test_a_run_ended_by_a_full_disk_can_be_resumed(uninterrupted, make, tmp_path, full):
    trainer = make(tmp_path)
    with ExitStack() as stack:

        def fill_the_disk():
            if full == "checkpoint":
                room = 10_000
            else:
                room = (tmp_path / full).stat().st_size + 9
                trainer.save = lambda: None  # none is due before the next row
            stack.enter_context(largest_file(room))

        at_step(trainer, 9, fill_the_disk)
        with pytest.raises(OSError, match="make room"):
            trainer.run()
    assert load_checkpoint(tmp_path / "checkpoint")["env_steps"] == 8
    assert (tmp_path / "train.csv").read_bytes().endswith(b"\n")
    make(tmp_path, resume=True).run()
    assert_same_run(tmp_path, uninterrupted)
