"""Effect of an action on the joint targets, which is the same in every task."""

import numpy as np
import pytest

from suites.nico.base import ACTION_SCALE, Environment


@pytest.fixture
def env(load) -> Environment:
    return load("grasp_glass", seed=0, observation="state")


def targets(env: Environment) -> np.ndarray:
    return np.array(env.physics.data.ctrl)


def test_actions_move_the_joint_targets(env):
    env.reset()
    # In the middle of all ranges, with targets where the joints are.
    env.physics.data.qpos[:12] = [0.1, -1.0, 0.5, *[0.45] * 9]
    env.physics.data.ctrl[:] = [0.1, -1.0, 0.5, *[0.45] * 3]
    env.task.before_step(np.array([0.5, -1.0, 0.25, -0.5]), env.physics)
    np.testing.assert_allclose(targets(env), [0.2, -1.2, 0.55, *[0.25] * 3])
    # The next action starts from the targets, not from the joints, which have not moved.
    env.task.before_step(np.array([0.5, 0.0, -0.25, 0.5]), env.physics)
    np.testing.assert_allclose(targets(env), [0.3, -1.2, 0.5, *[0.45] * 3])


def test_targets_do_not_run_away_from_the_joints(env):
    env.reset()
    joints = np.array([0.1, -1.0, 0.5, 0.45, 0.45, 0.45])
    env.physics.data.qpos[:12] = [*joints[:3], *[0.45] * 9]
    # Targets two steps ahead of joints that something holds back: brought back to one step.
    ahead = ACTION_SCALE[[0, 1, 2, 3, 3, 3]] * [1, -1, 1, -1, -1, -1]
    env.physics.data.ctrl[:] = joints + 2 * ahead
    env.task.before_step(np.zeros(4), env.physics)
    np.testing.assert_allclose(targets(env), joints + ahead)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_targets_stay_within_the_range_of_the_joints(env, sign):
    env.reset()
    # The arm raised behind the robot, where nothing is in its way.
    env.physics.data.qpos[1] = env.physics.data.ctrl[1] = -1.5
    env.physics.forward()
    reached = []
    for _ in range(20):
        env.step(np.array([sign, -1.0, sign, sign]))
        reached.append(targets(env))
    degrees = np.array([100, -100, 85, 160 / 3]) * [sign, 1, sign, sign > 0]
    np.testing.assert_allclose(reached[-1], np.radians(degrees)[[0, 1, 2, 3, 3, 3]], atol=1e-3)


def test_actions_beyond_the_range_count_as_its_ends(env):

    def target(action: list[float]) -> np.ndarray:
        env.task.random.seed(0)
        env.reset()
        env.task.before_step(np.array(action), env.physics)
        return targets(env)

    np.testing.assert_array_equal(target([9.0, -3.0, 1.5, -7.0]), target([1.0, -1.0, 1.0, -1.0]))


@pytest.mark.parametrize(
    "action",
    [np.zeros(3), np.zeros((1, 4)), [0, np.nan, 0, 0], [0, 0, np.inf, 0]],
    ids=["three", "two dimensions", "nan", "inf"],
)
def test_bad_actions_are_refused_before_anything_moves(env, action):
    env.reset()
    before = env.physics.get_state()
    with pytest.raises(ValueError, match="4 finite numbers"):
        env.step(action)
    np.testing.assert_array_equal(env.physics.get_state(), before)
