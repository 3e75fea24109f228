"""Examples run in an empty folder and print what they describe."""

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bgpo_trl.data.dataset import load_demonstrations
from bgpo_trl.encoders.representation import load_representation
from suites import nico
from tests.helpers import rows

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run an example as `python examples/NAME.py` in an empty folder; return what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(name):
        monkeypatch.setattr(sys, "argv", [name])
        with torch.random.fork_rng(devices=[]):
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_own_task_is_recorded_learned_and_counted_under_its_name(run):
    out = run("own_task.py")

    name, old = "push_white_to_green", nico.PAPER_TASKS
    recorded = load_demonstrations("runs/own-task/demonstrations")
    assert f"12 demonstrations, {recorded['length'].float().mean():.0f} frames each\n" in out
    train, tests = (rows(f"runs/own-task/run/{file}.csv") for file in ("train", "eval"))
    assert [int(row["episode"]) for row in train] == list(range(1, 9))
    assert {row["task"] for row in train[:2]} == {name}
    assert [row["task"] for row in tests] == [name, old[0], name, *old]
    for task in (name, *old):
        counts = [
            (sum(row["success"] == "1" for row in played), len(played))
            for played in ([r for r in file if r["task"] == task] for file in (train, tests))
        ]
        (won, n), (passed, m) = counts
        assert f"{task}: {won} of {n} in training, {passed} of {m} tests\n" in out
    assert Path("runs/own-task/success.png").read_bytes().startswith(b"\x89PNG")

    assert run("own_task.py") == out  # a finished run is reported again, and not repeated


# An unbounded state is no mistake.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*imum value is:UserWarning")
def test_stable_baselines3_trains_on_a_task(run):
    out = run("sb3_on_nico.py")
    assert re.fullmatch(r"grasp_glass: \d+% of 10 test episodes succeed after 300 steps\n", out)


def test_own_pipeline_rewards_novelty_and_plays_episodes(run):
    out = run("own_pipeline.py")

    printed = re.findall(r"reward ([\d.]+) a step, (\d+) places\n", out)
    assert len(printed) == 5
    places = [int(n) for _, n in printed]
    assert places == sorted(places)
    assert places[0] > 2
    # Novelty alone is worth less than 0.01; it is never 0 and never the maximum.
    rewards = np.array([float(reward) for reward, _ in printed])
    assert ((rewards > 0.0005) & (rewards < 0.1)).all()
    episodes, behaviors = re.search(r"(\d+) episodes, (\d+) behaviors\n$", out).groups()
    assert int(episodes) >= 20  # 1,000 steps, at most 50 an episode
    assert int(behaviors) > 2  # two that GWR-B starts with


def test_own_baseline_succeeds_more_often_than_random_actions(run):
    out = run("own_baseline.py")

    tests = rows("runs/own-baseline/run/eval.csv")
    assert {row["algorithm"] for row in tests} == {"knn"}
    success = {
        task: float(np.mean([int(row["success"]) for row in tests if row["task"] == task]))
        for task in nico.PAPER_TASKS
    }
    assert len(tests) == 15
    assert out == f"knn {success}\n"
    # Random actions succeed in 2 to 8 % of such episodes.
    assert np.mean([*success.values()]) > 0.15
    assert run("own_baseline.py") == out  # resumed, though there is nothing learned to load


def test_own_encoder_is_frozen_and_a_run_learns_from_what_it_sees(run):
    out = run("own_encoder.py")

    explained, nearest = re.match(r"R2 of .*: (0\.\d+)\nnearest .*: (\d+)%\n", out).groups()
    assert float(explained) > 0.2
    assert int(nearest) >= 75  # 50 by chance
    assert re.search(r"behavior \d+, first action \[.*\]\n$", out)
    folder = Path("runs/own-encoder")
    assert [int(row["episode"]) for row in rows(folder / "run/train.csv")] == [1, 2, 3, 4]

    names = runpy.run_path(str(EXAMPLES / "own_encoder.py"))
    encoders = load_representation(folder / "run/encoders/encoders.safetensors")
    network = encoders.frame_network
    assert type(network) is names["RandomPlaces"]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)  # of the encoders' training
        untrained = names["RandomPlaces"]((32, 64))
    for ours, theirs in zip(network.parameters(), untrained.parameters(), strict=True):
        assert ours.equal(theirs)
    frame = torch.zeros(1, 32, 64, 3, dtype=torch.uint8)
    frame[:, 12:16, 24:28] = 255
    here, across = network.features(torch.cat([frame, frame.roll(8, 2)]))
    moved = (across - here).view(2, 32)  # along the columns, along the rows
    assert (moved[0] > 0).all() and moved[1].abs().max() < 1e-3
    assert run("own_encoder.py") == out


def test_gwr_alone_finds_two_clusters(run):
    out = run("gwr_alone.py")

    nodes, edges, clusters = map(int, re.match(r"(\d+) nodes, (\d+) edges, (\d+) cl", out).groups())
    assert clusters == 2
    assert 20 < nodes < 200
    assert edges >= nodes - clusters
    right = float(re.search(r"cluster of their own kind: ([\d.]+)%\n", out).group(1))
    assert right > 99
    assert np.asarray(Image.open("runs/gwr-alone.png").convert("RGB")).std() > 5


@pytest.mark.slow
def test_own_robot_is_trained_and_tested_without_a_simulation(run):
    left, right = (
        int(re.search(rf"^{task}: (\d+) of 10 tests on the robot succeed$", out, re.M).group(1))
        for out in [run("own_robot.py")]
        for task in ("left", "right")
    )
    assert left + right >= 6  # of random actions, 31 of 400 episodes succeed
    assert not rows("runs/own-robot/run/eval.csv")
    train = rows("runs/own-robot/run/train.csv")
    assert len(train) == 60 and {row["seed"] for row in train} == {"0"}


@pytest.mark.slow
def test_own_scene_is_learned_from_its_pixels(run):
    out = run("own_scene.py")

    chance, last = {}, {}
    for line in out.splitlines():
        task, *rates = re.match(r"(\w+): random actions (\d+)%, .* (\d+)%$", line).groups()
        chance[task], last[task] = map(int, rates)
    assert [*last] == ["stretch_left", "stretch_right"]
    assert max(chance.values()) <= 10
    assert min(last.values()) >= 40
