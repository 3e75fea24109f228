"""Tasks on the command line, and what follows from them."""

import pytest

from bgpo_trl.configs import PRESETS
from bgpo_trl.experiments.arguments import Arguments, at_once, run_config
from suites import nico

ONE, TWO, THREE = nico.PAPER_TASKS


class Juggle(nico.NicoTask):
    """A task in name only."""


@pytest.fixture(autouse=True)
def added():
    nico.add_task("juggle", Juggle)


@pytest.mark.parametrize(
    ("tasks", "episodes", "starts"),
    [
        ((TWO,), None, (0,)),
        ((TWO, "juggle"), None, (0, 600)),
        ((TWO, "juggle"), 100, (0, 50)),
        (("juggle", ONE, TWO), None, (0, 380, 700)),  # as many as the preset has
        ((ONE, TWO, THREE, "juggle"), None, (0, 300, 600, 900)),
    ],
)
def test_tasks_are_presented_in_their_order(tasks, episodes, starts):
    config = run_config(Arguments(tasks=tasks, episodes=episodes))
    assert (config.tasks, config.task_starts) == (tasks, starts)
    assert at_once(config).task_starts == (0,) * len(tasks)


def test_all_tasks_of_the_suite_come_at_even_intervals():
    config = run_config(Arguments(tasks=("all",), episodes=4_000))
    assert config.tasks == nico.ALL_TASKS and len(config.tasks) == 8
    assert config.task_starts == tuple(range(0, 4_000, 500))


def test_by_default_they_are_the_presets():
    assert run_config(Arguments()).tasks == PRESETS["quick"].tasks


@pytest.mark.parametrize(
    ("tasks", "said"),
    [
        (
            ("dance",),
            "^--tasks: there is no task 'dance'; name some of grasp_glass, .*--import MOD",
        ),
        ((), "^--tasks: it is empty; name some of grasp_glass"),
        ((ONE, ONE), "^the task 'grasp_glass' is named twice"),
    ],
)
def test_tasks_that_cannot_be_are_refused(tasks, said):
    with pytest.raises(ValueError, match=said):
        run_config(Arguments(tasks=tasks))
