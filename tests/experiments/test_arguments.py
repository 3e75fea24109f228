"""Tasks on the command line, and what follows from them."""

from dataclasses import replace

import pytest

from bgpo_trl.configs import PRESETS, BGPOConfig, GWRBConfig, MAMLConfig, RunConfig
from bgpo_trl.encoders.shipped import default_weights
from bgpo_trl.experiments.arguments import Arguments, at_once, for_encoders, run_config
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
        (("juggle", ONE, TWO), None, (0, 420, 780)),  # as many as the preset has
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


def test_groups_have_the_threshold_of_the_encoders_unless_they_have_their_own():
    paper, eight = (default_weights(tasks) for tasks in (nico.PAPER_TASKS, nico.ALL_TASKS))
    run = RunConfig(tasks=nico.ALL_TASKS, task_starts=(0,) * 8)
    assert for_encoders(run, paper) == run
    for_eight = for_encoders(run, eight)
    assert for_eight.algorithm.groups == replace(run.algorithm.groups, activity_threshold=0.595)
    assert replace(for_eight, algorithm=run.algorithm) == run
    assert for_encoders(for_eight, eight) == for_eight
    own = replace(run, algorithm=BGPOConfig(groups=GWRBConfig(activity_threshold=0.7)))
    assert for_encoders(own, eight) == own
    label = replace(run, algorithm=MAMLConfig())
    assert for_encoders(label, eight) == label
