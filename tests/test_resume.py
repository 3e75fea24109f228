"""Runs and trainings that are killed end as if uninterrupted."""

import multiprocessing
import time

import numpy as np
import pytest
import torch

from bgpo_trl.data.dataset import load_demonstrations
from bgpo_trl.encoders.pretrained import load_pretrained
from tests.resumable import play, train_small_encoders
from tests.test_training import assert_same_run

pytestmark = pytest.mark.usefixtures("easy_world")
often = pytest.mark.parametrize("times", [2, pytest.param(10, marks=pytest.mark.slow)])


def kill_again_and_again(target, arguments, progress, times):
    """Start `target` in a process and kill it at random moments; then let it end.

    Each process is killed a random moment after some progress, so as late on a slow machine as on a
    fast one. Processes are forks of one that has imported everything and has no window to the GPU.
    `progress` returns a number that grows.
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
    made = [load_pretrained(folder / "encoders.safetensors") for folder in (tmp_path, learned)]
    assert made[0][0].identity == made[1][0].identity
    assert made[0][1].embedding.equal(made[1][1].embedding)
    for name in ("demonstrations/dataset.json", "log/probes.json", "log/train.csv"):
        assert (tmp_path / name).read_text() == (learned / name).read_text()
    load_demonstrations(tmp_path / "demonstrations")  # compares the checksum
