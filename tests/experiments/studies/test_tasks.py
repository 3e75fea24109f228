"""The tables and the pictures of the suite's tasks."""

import numpy as np
import tasks as nico_tasks
from PIL import Image

from suites import nico


def test_chance_is_the_success_of_random_actions_step_by_step():
    env = nico.load("push_white_right", seed=3, observation="state")
    random, solved = np.random.default_rng(3), 0
    for _ in range(12):
        timestep = env.reset()
        actions = iter(random.uniform(-1.0, 1.0, (50, 4)))
        while not timestep.last():
            timestep = env.step(next(actions))
        solved += bool(timestep.reward)
    assert solved > 0
    assert nico_tasks.chance("push_white_right", episodes=12, seed=3) == solved / 12


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
