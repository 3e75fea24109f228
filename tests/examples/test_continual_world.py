"""Continual World's tasks as a scene. Needs Meta-World, which is not among our dependencies."""

import numpy as np
import pytest

pytest.importorskip("metaworld", reason="Meta-World is not installed (docs/extending.md)")

from examples.continual_world import CW10, WITH_GOAL, WITH_PUCK, ContinualWorld

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def worlds():
    return {}


def begin(worlds, task, seed=0):
    simulation = ContinualWorld(worlds)
    simulation.seed(seed)
    simulation.reset(task)
    return simulation


@pytest.mark.parametrize("task", WITH_GOAL)
def test_a_goal_is_seen_and_drawn_anew(worlds, task):
    frames, goals = [], []
    for seed in (0, 1):
        simulation = begin(worlds, task, seed)
        frames.append(simulation.frame().astype(int))
        goals.append(simulation.observation[36:39].copy())
    for red, green, blue in (frame.transpose(2, 0, 1) for frame in frames):
        assert (green > 100 + np.maximum(red, blue)).sum() >= 2
    assert not np.array_equal(*goals)


@pytest.mark.parametrize("task", WITH_PUCK)
def test_a_puck_is_seen_in_both_views_and_a_wall_where_there_is_one(worlds, task):
    red, green, blue = begin(worlds, task).frame().astype(int).transpose(2, 0, 1)
    yellow = np.minimum(red, green) > 60 + blue
    assert all(view.any() for view in np.hsplit(yellow, 2))
    purple = blue > 40 + green
    assert purple.any() == (task == "push-wall")


def test_success_at_any_simulation_step_ends_the_episode(worlds, monkeypatch):
    simulation = begin(worlds, "push")
    reports = iter([False] * 5 + [True] + [False] * 9)

    def step(env, action):
        return simulation.observation, 0.0, False, False, {"success": next(reports)}

    monkeypatch.setattr(type(simulation.world.env), "step", step)
    outcomes = [simulation.step(np.zeros(4)).success for _ in range(3)]
    assert outcomes == [False, True, False]


@pytest.mark.parametrize("task", CW10)
def test_a_saved_episode_continues_bit_by_bit(worlds, task):
    simulation = begin(worlds, task, seed=8)
    random = np.random.default_rng(0)
    for action in random.uniform(-1, 1, (4, 4)):
        simulation.step(action)
    resumed = ContinualWorld(worlds)
    resumed.load(simulation.save())
    for each in (simulation, resumed):
        each.step(np.ones(4))
    assert np.array_equal(simulation.observation, resumed.observation)
    assert np.array_equal(simulation.frame(), resumed.frame())
