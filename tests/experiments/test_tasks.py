"""The tables and the pictures of the suite's tasks."""

import numpy as np
import pytest
from PIL import Image

from bgpo_trl.experiments import tasks as nico_tasks
from suites import nico


class Reward(nico.NicoTask):
    """Solved once the hand's target is above a threshold."""

    threshold = 0.0

    def succeeded(self, physics):
        return bool(physics.data.ctrl[3] > self.threshold)


class Never(Reward):
    threshold = 10.0


@pytest.fixture
def judged(monkeypatch):
    """Two tasks, one of which any start solves."""
    monkeypatch.setattr(Reward, "threshold", -1.0)
    monkeypatch.setattr(nico_tasks.nico, "TASKS", {"always": Reward, "never": Never})


def test_random_actions_are_counted_for_each_task(judged):
    assert nico_tasks.chance(("always", "never"), episodes=2, seed=0) == {
        "always": 1.0,
        "never": 0.0,
    }


def test_success_of_random_actions_equals_that_in_the_task_alone():
    tasks = ("push_glass_right", "push_white_right")
    together = nico_tasks.chance(tasks, episodes=12, seed=3)

    for task in tasks:
        env = nico.load(task, seed=3, observation="state")
        random, solved = np.random.default_rng(3), 0
        for _ in range(12):
            timestep, actions = env.reset(), random.uniform(-1.0, 1.0, (50, 4))
            for action in actions:
                timestep = env.step(action)
                if timestep.last():
                    break
            solved += bool(timestep.reward)
        assert together[task] == solved / 12
    assert any(together.values())


def test_each_task_counts_the_steps_of_its_own_condition(monkeypatch):
    class Odd(nico.NicoTask):
        """Condition: the step is an odd one."""

        def succeeded(self, physics):
            return round(physics.time() / 0.2) % 2 == 1

    class TwoOdd(Odd):
        steady_steps = 2

    class Late(nico.NicoTask):
        """Condition: one of the last three steps."""

        steady_steps = 3

        def succeeded(self, physics):
            return physics.time() > 9.5

    class TooLate(Late):
        steady_steps = 4

    tasks = {"odd": Odd, "two odd": TwoOdd, "late": Late, "too late": TooLate}
    monkeypatch.setattr(nico_tasks.nico, "TASKS", tasks)

    found = nico_tasks.chance(tuple(tasks), episodes=2, seed=0)

    assert found == {"odd": 1.0, "two odd": 0.0, "late": 1.0, "too late": 0.0}


def test_tables_and_pictures_have_a_row_for_each_task_and_object(monkeypatch, tmp_path):
    tasks = ("push_green_to_white", "press_white")
    monkeypatch.setattr(nico_tasks.nico, "ALL_TASKS", tasks)

    printed = nico_tasks.tasks(nico_tasks.TasksArguments(starts=2, seed=1, pictures=tmp_path))
    _, _, *rows, _, _, _, glass, green, white, _, alike, first, second = printed.splitlines()
    assert [row.split("`")[1] for row in rows] == list(tasks)
    env = nico.load("grasp_glass", seed=1, observation="state")
    places = []
    for _ in range(2):
        env.reset()
        places.append([env.physics.object_position(name)[:2] for name in nico.OBJECTS])
    apart = 100 * np.abs(np.diff(places, axis=0)[0]) / np.sqrt(2)  # deviation of two numbers
    for row, name, (x, y) in zip((glass, green, white), nico.OBJECTS, apart, strict=True):
        assert row == f"| {name} | {x:.2f} | {y:.2f} |"
    assert alike == "The starts of all tasks are the same."
    for line, name, count in ((first, "tasks.png", 2), (second, "starts.png", 3)):
        assert line == f"picture: {tmp_path / name}"
        assert Image.open(tmp_path / name).size[1] == count * (64 + 14 + 4)
