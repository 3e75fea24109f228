"""The demonstrator: success, length, seeds and the order of its phases."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suites import nico
from suites.nico import kinematics, moves
from suites.nico.demonstrator import Demonstrator

all_tasks = pytest.mark.parametrize("task", nico.ALL_TASKS)


def demonstrate(env, demonstrator) -> tuple[np.ndarray, bool]:
    """Return the actions ``[T, 4]`` of an episode and whether it succeeded."""
    timestep, actions = env.reset(), []
    demonstrator.reset()
    while not timestep.last():
        actions.append(demonstrator(timestep))
        timestep = env.step(actions[-1])
    return np.stack(actions), bool(timestep.reward)


@all_tasks
def test_demonstrations_succeed_with_actions_in_range(physics, task):
    env = nico.load(task, seed=0, observation="state", physics=physics)
    demonstrator = Demonstrator(env, seed=0)

    episodes = [demonstrate(env, demonstrator) for _ in range(6)]

    assert sum(success for _, success in episodes) >= 5
    for actions, success in episodes:
        assert actions.shape[1:] == (4,)
        assert (np.abs(actions) <= 1).all()
        assert 8 < len(actions) <= 50
        assert success or len(actions) == 50


def test_it_needs_a_reset_and_a_task_with_a_demonstration(physics):
    env = nico.load("grasp_glass", seed=0, observation="state", physics=physics)
    with pytest.raises(RuntimeError, match="reset"):
        Demonstrator(env)(env.reset())
    demonstrator, timestep = Demonstrator(env), env.reset()
    demonstrator.reset()
    for _ in range(2):
        timestep = env.step(demonstrator(timestep))
    with pytest.raises(RuntimeError, match="reset"):
        demonstrator(env.reset())
    env._task = type("Juggle", (nico.NicoTask,), {})(random=np.random.RandomState(0))
    with pytest.raises(ValueError, match="Juggle"):
        Demonstrator(env)


# Source of the middle of any distribution.
NO_NOISE: Any = SimpleNamespace(
    normal=lambda mean, _, size: np.full(size, mean), uniform=lambda low, high: (low + high) / 2
)


@pytest.mark.parametrize(
    ("degrees", "right"), [(24.0, 0.075), (20.0, 0.42 * np.radians(20) - 0.094), (14.0, 0.03)]
)
def test_a_grasp_starts_closer_to_a_glass_with_a_near_neighbor(physics, degrees, right):
    with physics.reset_context():
        for name, angle in (("glass", 20.0), ("green_box", 20.0 - degrees), ("white_box", -40.0)):
            place = kinematics.polar(0.42, np.radians(angle))
            physics.named.data.qpos[name][:2] = place

    above, *_ = moves.grasp(physics, NO_NOISE, "glass")
    physics.data.qpos[:3] = above.place(physics)
    physics.forward()

    radius, angle = kinematics.to_polar(physics.grip_position())
    assert radius == pytest.approx(0.42, abs=1e-3)
    assert 0.42 * (np.radians(20) - angle) == pytest.approx(right, abs=1e-3)


def test_a_phase_with_a_further_condition_lasts_until_it_holds(physics, monkeypatch):
    # The hand is half open at the start.
    env = nico.load("grasp_glass", seed=0, spread=0.0, observation="state", physics=physics)
    calls = []

    def fourth_time(_) -> bool:
        calls.append(len(calls))
        return len(calls) == 4

    def stay(physics) -> np.ndarray:
        return physics.data.ctrl[:3].copy()

    def movement(physics, random):
        return [moves.Phase(stay, 0.9, until=fourth_time), moves.Phase(stay, 0.0)]

    monkeypatch.setattr(type(env.task), "demonstration", lambda _, *arguments: movement(*arguments))
    demonstrator = Demonstrator(env, seed=0)
    timestep = env.reset()
    demonstrator.reset()
    while len(calls) < 4 and not timestep.last():
        action = demonstrator(timestep)
        if 0 < len(calls) < 4:
            assert action[3] > 0  # closes
        timestep = env.step(action)

    assert len(calls) == 4
    assert action[3] < 0  # opens


def test_a_phase_ends_at_its_limit_and_the_last_phase_leads_to_a_new_plan(physics, monkeypatch):
    env = nico.load("grasp_glass", seed=0, spread=0.0, observation="state", physics=physics)
    planned = []

    def out_of_reach(physics) -> np.ndarray:
        return physics.data.ctrl[:3] + np.array([1.0, 0.0, 0.0])

    def movement(physics, random):
        planned.append(len(curls))
        return [moves.Phase(out_of_reach, 0.9, limit=3), moves.Phase(out_of_reach, 0.0, limit=2)]

    monkeypatch.setattr(type(env.task), "demonstration", lambda _, *arguments: movement(*arguments))
    demonstrator, curls = Demonstrator(env, seed=0), []
    timestep = env.reset()
    demonstrator.reset()
    lifting = 0
    while len(planned) < 2 and not timestep.last():
        action = demonstrator(timestep)
        lifting += len(demonstrator._phases) == 3
        curls.append(np.sign(action[3]))
        timestep = env.step(action)

    # The new plan begins with the lifting of the hand, which takes the step of the latest action.
    assert planned[1] == len(curls) - 1
    assert lifting == len(curls) - 5
    assert curls[-6:-1] == [1.0] * 3 + [-1.0] * 2


@pytest.mark.slow
@all_tasks
def test_95_percent_succeed_in_20_to_40_steps(physics, task):
    env = nico.load(task, seed=101, observation="state", physics=physics)
    demonstrator = Demonstrator(env, seed=101)
    episodes = [demonstrate(env, demonstrator) for _ in range(200)]
    steps = [len(actions) for actions, success in episodes if success]
    assert len(steps) >= 0.95 * 200
    assert 20 <= np.mean(steps) <= 40


@pytest.mark.slow
def test_100_000_random_steps_without_a_warning(physics):
    random = np.random.default_rng(0)
    environments = [
        nico.load(task, seed=0, observation="state", physics=physics) for task in nico.ALL_TASKS
    ]
    steps = episode = 0
    while steps < 100_000:
        env = environments[episode % len(environments)]
        timestep = env.reset()
        # Held for some steps and often at the ends of the range, actions drive the arm further.
        hold, decimals = random.integers(1, 20), int(random.integers(0, 3))
        actions = np.repeat(random.uniform(-1.0, 1.0, (50, 4)).round(decimals), hold, axis=0)
        for action in actions[:50]:
            timestep = env.step(action)
            steps += 1
            if timestep.last():
                break
        # Before the next reset, which clears the counts.
        assert not any(warning.number for warning in physics.data.warning)
        episode += 1
