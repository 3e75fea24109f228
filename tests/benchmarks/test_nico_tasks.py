"""The table and the picture of the suite's tasks."""

import nico_tasks
import numpy as np
import pytest
from PIL import Image

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


def test_chance_is_counted_for_each_task_in_the_same_episodes(judged):
    assert nico_tasks.chance(("always", "never"), episodes=2, seed=0) == {
        "always": 1.0,
        "never": 0.0,
    }


def test_chance_is_that_of_episodes_of_the_task_alone():
    tasks = ("push_glass_right", "push_white_right")
    together = nico_tasks.chance(tasks, episodes=6, seed=3)

    for task in tasks:
        judge = nico.TASKS[task](random=0)
        env = nico.load("grasp_glass", seed=3, observation="state")
        env.task.succeeded = lambda _: False
        random, solved = np.random.default_rng(3), 0
        for _ in range(6):
            timestep, success = env.reset(), False
            while not timestep.last():
                timestep = env.step(random.uniform(-1.0, 1.0, 4))
                success |= judge.succeeded(env.physics)
            solved += success
        assert together[task] == solved / 6


def test_table_and_picture_have_a_row_for_each_task(monkeypatch, tmp_path, capsys):
    tasks = ("push_green_to_white", "press_white")
    monkeypatch.setattr(nico_tasks.nico, "ALL_TASKS", tasks)
    path = tmp_path / "tasks.png"

    nico_tasks.main(nico_tasks.Arguments(starts=1, seed=1, picture=path))

    header, _, *rows, last = capsys.readouterr().out.splitlines()
    assert header == "| task | chance | demonstrator | steps |"
    assert [row.split("`")[1] for row in rows] == list(tasks)
    assert last == f"picture: {path}"
    assert Image.open(path).size[1] == 2 * (64 + 14 + 4)
