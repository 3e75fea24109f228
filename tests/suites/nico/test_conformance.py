"""Rules that every task of the suite keeps, after ``dm_control.suite.tests.suite_test``.

One task alone is tested for behavior that the base class gives to every task.
"""

import itertools
import re

import numpy as np
import pytest

from suites import nico
from suites.nico import base, kinematics
from suites.nico.physics import OBJECT_HALF_HEIGHT, OBJECTS, TABLE_HEIGHT, Physics


def random_actions(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 4))


def test_observations_and_actions_have_the_specs_of_the_paper(load):
    assert nico.PAPER_TASKS == ("grasp_glass", "push_green_to_glass", "push_green_to_white")
    assert nico.ALL_TASKS[:3] == nico.PAPER_TASKS
    env = load("push_white_left", seed=0, observation="both")
    specs, action = env.observation_spec(), env.action_spec()
    assert (specs["pixels"].shape, specs["pixels"].dtype) == ((32, 64, 3), np.uint8)
    assert (specs["privileged_state"].shape, specs["privileged_state"].dtype) == ((16,), np.float64)
    assert (action.shape, action.dtype) == ((4,), np.float64)
    assert (action.minimum.tolist(), action.maximum.tolist()) == ([-1.0] * 4, [1.0] * 4)


def test_state_is_joints_grip_and_objects(load):
    env = load("grasp_glass", seed=0, observation="state")
    state = env.reset().observation["privileged_state"]
    angles, positions = env.physics.named.data.qpos, env.physics.named.data
    hand = [angles["thumb_1"], angles["upper_finger_1"], angles["lower_finger_1"]]
    arm = [angles["shoulder_yaw"], angles["shoulder_pitch"], angles["elbow"]]
    expected = [*np.ravel(arm), np.mean(hand), *positions.site_xpos["grip"]]
    expected += [x for name in ("glass", "green_box", "white_box") for x in positions.xpos[name]]
    np.testing.assert_array_equal(state, expected)


def test_time_out_is_after_50_steps_and_keeps_the_discount(load):
    env = load("grasp_glass", seed=0, observation="state")
    env.reset()
    timesteps = [env.step(np.zeros(4)) for _ in range(50)]
    assert [timestep.last() for timestep in timesteps] == [False] * 49 + [True]
    assert {timestep.reward for timestep in timesteps} == {0.0}
    assert {timestep.discount for timestep in timesteps} == {1.0}
    assert env.step(np.zeros(4)).first()


@pytest.mark.parametrize("steps", [1, 2])
def test_success_has_discount_0_even_on_the_last_step(load, monkeypatch, steps):
    env = load("grasp_glass", seed=0, observation="state", time_limit=0.4)
    monkeypatch.setattr(env.task, "steady_steps", 1)
    monkeypatch.setattr(env.task, "succeeded", lambda _: False)
    env.reset()
    for _ in range(steps - 1):
        env.step(np.zeros(4))
    monkeypatch.setattr(env.task, "succeeded", lambda _: True)
    timestep = env.step(np.zeros(4))
    assert timestep.last()
    assert (timestep.reward, timestep.discount) == (1.0, 0.0)


@pytest.mark.parametrize("task", nico.ALL_TASKS)
def test_success_must_hold_for_consecutive_steps(load, monkeypatch, task):
    env = load(task, seed=0, observation="state")
    needed = 3 if task in ("grasp_glass", "lift_green") else 2
    now = iter([True] * (needed - 1) + [False] + [True] * needed)
    monkeypatch.setattr(env.task, "succeeded", lambda _: next(now))
    env.reset()
    timesteps = [env.step(np.zeros(4)) for _ in range(2 * needed)]
    assert [timestep.reward for timestep in timesteps] == [0.0] * (2 * needed - 1) + [1.0]
    assert [timestep.last() for timestep in timesteps] == [False] * (2 * needed - 1) + [True]


def test_to_advance_is_a_step_without_its_observation(load, monkeypatch):
    env = load("grasp_glass", seed=0, observation="state")
    monkeypatch.setattr(env.task, "succeeded", lambda physics: physics.time() > 1.5)
    env.reset()
    start, expected = env.physics.get_state(), []
    for action in random_actions(10):
        expected.append((env.step(action).last(), env.physics.get_state()))
    assert [last for last, _ in expected] == [False] * 9 + [True]
    monkeypatch.setattr(env.task, "get_observation", None)
    env.physics.set_state(start)
    for action, (last, state) in zip(random_actions(10), expected, strict=True):
        assert env.advance(action) == (last, last)
        np.testing.assert_array_equal(env.physics.get_state(), state)


def test_the_duration_of_success_is_part_of_the_state(load, monkeypatch):
    env, holds = load("grasp_glass", seed=0, observation="state"), True
    monkeypatch.setattr(env.task, "succeeded", lambda _: holds)
    env.reset()
    for _ in range(env.task.steady_steps - 1):
        env.step(np.zeros(4))
    state = env.physics.get_state()
    holds = False
    env.step(np.zeros(4))
    assert env.physics.steady_steps == 0
    holds = True
    env.physics.set_state(state)
    timestep = env.step(np.zeros(4))
    assert (timestep.reward, timestep.discount) == (1.0, 0.0)
    # A new episode counts from the beginning.
    env.reset()
    assert env.step(np.zeros(4)).reward == 0.0


def test_starts_depend_on_episode_and_seed_and_not_on_the_task(load):
    def starts(name: str, seed: int, count: int) -> list[np.ndarray]:
        env = load(name, seed=seed, observation="state")
        return [env.reset().observation["privileged_state"] for _ in range(count)]

    found = [*starts("grasp_glass", 0, 5), *starts("grasp_glass", 1, 1)]
    table_heights = [9, 12, 15]
    for first, second in itertools.combinations(found, 2):
        assert (np.delete(first - second, table_heights) != 0).all()
    for task in nico.ALL_TASKS[1:]:
        np.testing.assert_array_equal(found[:2], starts(task, 0, 2))


def test_observations_share_no_memory(load):
    env = load("grasp_glass", seed=0, observation="both")
    observations = [env.reset().observation]
    observations += [env.step(action).observation for action in random_actions(3)]
    for first, second in itertools.combinations(observations, 2):
        for key in first:
            assert not np.shares_memory(first[key], second[key])
    before = env.physics.get_state()
    observations[-1]["privileged_state"][:] = 0
    np.testing.assert_array_equal(env.physics.get_state(), before)


def polar_places(physics: Physics) -> np.ndarray:
    """Return radius (m), angle (rad) and turn (rad) of each object, ``[3, 3]``."""
    poses = [physics.named.data.qpos[name] for name in OBJECTS]
    return np.array(
        [[*kinematics.to_polar(pose[:2]), 2 * np.arctan2(pose[6], pose[3])] for pose in poses]
    )


@pytest.mark.parametrize("spread", [1.0, 0.3, 0.0])
def test_objects_start_apart_and_upright_on_the_table(load, spread):
    env = load("grasp_glass", seed=0, spread=spread, observation="state")
    physics = env.physics
    low, high = physics.model.jnt_range[:12].T
    tasks = [task(random=0) for task in nico.TASKS.values()]
    for _ in range(80):
        env.reset()
        for name in OBJECTS:
            position = physics.object_position(name)
            bottom = position[2] - OBJECT_HALF_HEIGHT[name]
            assert bottom == pytest.approx(TABLE_HEIGHT, abs=1e-3)
            assert 0.305 < position[0] < 0.85 and abs(position[1]) < 0.55  # on the table
            assert physics.named.data.xmat[name, "zz"] > 0.999  # upright
        for first, second in itertools.combinations(OBJECTS, 2):
            assert physics.gap(first, second) > 0.05
        assert not physics.robot_touches()
        assert not any(task.succeeded(physics) for task in tasks)
        assert (physics.data.qpos[:12] >= low).all() and (physics.data.qpos[:12] <= high).all()


def test_starts_are_spread_over_the_table(load):
    env = load("grasp_glass", seed=0, observation="state")
    places, polar = [], []
    for _ in range(200):
        env.reset()
        places.append([env.physics.object_position(name)[:2] for name in OBJECTS])
        polar.append(polar_places(env.physics))
    deviation = 100 * np.std(places, axis=0)  # (cm)
    for name, (x, y) in zip(OBJECTS, deviation, strict=True):
        # Of the green box 1.44 cm in the long run, since its radius is near to two others.
        assert x >= (1.3 if name == "green_box" else 1.5)
        assert y >= (3.5 if name == "green_box" else 6.0)

    radii, angles, turns = np.moveaxis(polar, -1, 0)
    glass, green, white = angles.T
    is_left = glass > white
    assert 70 < is_left.sum() < 130
    neighbors = np.sort(angles, axis=1)
    np.testing.assert_array_equal(neighbors[:, 1], green)
    assert np.diff(neighbors).min() >= np.radians(20) - 1e-9
    assert np.abs(np.diff(radii)).max() <= 0.03 + 1e-9
    # Also on one and the same side.
    assert 100 * np.std(0.4 * glass[is_left]) > 1.5
    assert np.std(turns, axis=0).min() > 1.5  # (rad), of any turn


def test_without_spread_objects_are_at_their_nominal_places(load):
    env = load("grasp_glass", seed=0, spread=0.0, observation="state")
    for _ in range(3):
        env.reset()
        places = [env.physics.object_position(name) for name in OBJECTS]
        np.testing.assert_allclose(places, nico.nominal_places(), atol=1e-12)
        np.testing.assert_allclose(polar_places(env.physics)[:, 1], np.radians([22, 0, -22]))
        np.testing.assert_array_equal(polar_places(env.physics)[:, 2], 0)
    state = env.physics.get_state()
    env.reset()
    np.testing.assert_array_equal(env.physics.get_state(), state)


def test_a_smaller_spread_scales_the_draws(load):
    nominal = np.array([[0.4, angle, 0.0] for angle in np.radians([22, 0, -22])])
    swapped = nominal[::-1]
    sides = []
    for seed in range(200):
        found = []
        for spread in (1.0, 0.5):
            env = load("grasp_glass", seed=seed, spread=spread, observation="state")
            env.reset()
            places = polar_places(env.physics)
            is_swapped = places[0, 1] < places[2, 1]
            found.append((is_swapped, places - (swapped if is_swapped else nominal)))
        (whole_side, whole), (half_side, half) = found
        np.testing.assert_allclose(half[:, [0, 2]], whole[:, [0, 2]] / 2, atol=1e-9)
        if half_side == whole_side:
            np.testing.assert_allclose(half[:, 1], whole[:, 1] / 2, atol=1e-9)
        sides.append((whole_side, half_side))
    whole_side, half_side = np.array(sides).T
    assert 0.40 < whole_side.mean() < 0.60
    assert 0.16 < half_side.mean() < 0.34
    assert not (half_side & ~whole_side).any()


def test_bad_arguments_are_refused():
    for options in (
        {"task": "juggle"}, {"observation": "sound"}, {"spread": -0.01}, {"spread": 1.01},
        {"spread": np.nan},
    ):  # fmt: skip
        (name,) = options
        with pytest.raises(ValueError, match=name):
            nico.load(**{"task": "grasp_glass", **options})


@pytest.mark.parametrize("name", ["ACTION_SCALE", "ARC_RADIUS", "GREEN_JITTER", "SIDE_JITTER"])
def test_the_scene_version_changes_with_the_constants_of_the_scene(monkeypatch, name):
    version = nico.scene_version()
    assert re.fullmatch(r"nico-2-[0-9a-f]{8}", version)
    assert nico.scene_version() == version
    monkeypatch.setattr(base, name, getattr(base, name) * 1.01)
    assert nico.scene_version() != version
