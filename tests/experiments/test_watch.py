"""Films of what a run has learned."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from bgpo_trl.experiments import watch
from suites import nico
from suites.nico.demonstrator import Demonstrator
from tests.helpers import contents

GREEN, RED = (0x00, 0x9E, 0x73), (0xD5, 0x5E, 0x00)


@pytest.mark.parametrize("name", ["bgpo", "oracle"])
def test_a_film_has_its_files_and_leaves_the_run_unchanged(run_of, tmp_path, monkeypatch, name):
    """With demonstrations that take no time and show nothing."""
    frames = np.random.default_rng(0).integers(256, size=(7, 32, 64, 3), dtype=np.uint8)
    monkeypatch.setattr(watch, "demonstrate", lambda tasks, *_: dict.fromkeys(tasks, frames))
    run, out = run_of(name), tmp_path / "pictures"
    before = contents(run)
    printed = watch.watch(watch.WatchArguments(run, run_seed=8, out=out))
    assert contents(run) == before
    assert {path.name for path in out.iterdir()} == {"film.gif", "film.png"}
    first, *outcomes, last = printed.splitlines()
    assert re.fullmatch(r"seed 8 after \d+ of \d+ episodes", first)
    assert [line.split(": ")[0] for line in outcomes] == [*nico.PAPER_TASKS]
    assert last == f"pictures: {out}"


def test_an_episode_has_the_frames_of_the_policys_actions():
    env = nico.load("push_green_to_white", seed=3)
    demonstrator, timestep, actions = Demonstrator(env, seed=3), env.reset(), []
    demonstrator.reset()
    frames = [timestep.observation["pixels"]]
    while not timestep.last():
        actions.append(demonstrator(timestep))
        timestep = env.step(actions[-1])
        frames.append(timestep.observation["pixels"])
    assert timestep.reward

    shown_to, seen, left = [], [], list(actions)
    algorithm = SimpleNamespace(max_steps=50)
    policy = SimpleNamespace(
        condition=lambda demonstration, task: shown_to.append((demonstration, task)),
        act=lambda frame, joints: seen.append(frame) or left.pop(0),
        algorithm=SimpleNamespace(joints=None),
        config=SimpleNamespace(algorithm=algorithm, scene="nico", spread=1.0),
    )
    episode = watch.play(policy, "push_green_to_white", np.stack(frames[:2]), 3)
    assert shown_to == [(episode.demonstration, "push_green_to_white")]
    np.testing.assert_array_equal(episode.seen, frames)
    np.testing.assert_array_equal(seen, frames[:-1])
    assert episode.view.shape == (len(frames), 128, 192, 3)
    assert len(np.unique(episode.view, axis=0)) > 1
    assert episode.outcome == f"success after {len(actions)} steps"

    left[:], algorithm.max_steps = actions, 4
    early = watch.play(policy, "push_green_to_white", episode.demonstration, 3)
    assert early.outcome == "no success after 4 steps"


@pytest.mark.parametrize(("success", "color"), [(True, GREEN), (False, RED)])
def test_the_frame_of_an_episode_has_the_color_of_its_outcome_from_its_end_on(success, color):
    black = np.zeros((4, 128, 192, 3), np.uint8)
    episode = watch.Episode("lift", black[:, :32, :64], black[:2, :32, :64], black[:2], success)
    pictures = watch.compose([episode])
    assert len(pictures) == 4 + 2 * 10  # those of the demonstration; the last one is held
    framed = [int((np.abs(p - np.array(color)) < 9).all(-1).sum()) for p in pictures.astype(int)]
    assert framed[0] == 0
    assert min(framed[1:]) > 2 * 4 * 2 * (128 + 192)  # two pictures with borders of 4 pixels
