"""The tasks in dm_env, dm_control's suite, TorchRL, Gymnasium and Stable-Baselines3."""

import importlib
import sys
import unittest
import unittest.mock

import gymnasium
import numpy as np
import pytest
from dm_control import suite
from dm_env import test_utils
from gymnasium.utils.env_checker import check_env
from shimmy import DmControlCompatibilityV0
from torchrl.envs import DMControlEnv, check_env_specs

from suites import nico


def failures(tests: type[unittest.TestCase]) -> list[str]:
    """Return the failures of a test case, which must have tests."""
    result = unittest.TestResult()
    unittest.defaultTestLoader.loadTestsFromTestCase(tests).run(result)
    assert result.testsRun
    return [trace for _, trace in result.failures + result.errors]


@pytest.mark.parametrize(
    ("observation", "flat", "keys"),
    [
        ("pixels", False, {"pixels"}),
        ("state", False, {"privileged_state"}),
        ("both", True, {"observations"}),
    ],
)
def test_dm_envs_own_tests_pass(load, observation, flat, keys):
    options = {"observation": observation, "environment_kwargs": {"flat_observation": flat}}

    class Checks(test_utils.EnvironmentTestMixin, unittest.TestCase):
        def make_object_under_test(self):
            return load("push_white_left", seed=0, time_limit=1.0, **options)

        def make_action_sequence(self):  # Long enough to come to the end of two episodes.
            yield from np.random.default_rng(0).uniform(-1.0, 1.0, (13, 4))

    assert failures(Checks) == []
    assert {*load("push_white_left", **options).observation_spec()} == keys


@pytest.fixture
def registered(monkeypatch) -> None:
    for name in ("ALL_TASKS", "EXTRA", "NO_REWARD_VIZ", "TASKS_BY_DOMAIN", "_DOMAINS"):
        content = getattr(suite, name)
        monkeypatch.setattr(suite, name, type(content)(content))
    nico.register()


# A frame's corners always show the table, and names are part of the scene, whose version is fixed.
UNMET = ("test_observations_dont_contain_constant_elements", "test_components_have_names")


def test_dm_controls_own_tests_pass(registered, monkeypatch):
    monkeypatch.setitem(sys.modules, "mock", unittest.mock)
    # Its cases are the tasks that are there when it is imported.
    ours = tuple(("nico", task) for task in nico.ALL_TASKS)
    monkeypatch.setattr(suite, "ALL_TASKS", ours)
    monkeypatch.setattr(suite, "TASKS_BY_DOMAIN", {"nico": nico.ALL_TASKS})
    monkeypatch.delitem(sys.modules, "dm_control.suite.suite_test", raising=False)
    tests = importlib.import_module("dm_control.suite.suite_test").SuiteTest
    unmet = [name for name in dir(tests) if name.startswith(UNMET)]
    assert len(unmet) == len(UNMET) * len(ours)
    for name in (*unmet, *(name for name in dir(tests) if "visualize" in name)):
        delattr(tests, name)
    assert failures(tests) == []


def test_registered_tasks_are_listed_once_and_other_suites_stay_unchanged(registered):
    def others(name: str) -> list:
        return [pair for pair in getattr(suite, name) if pair[0] != "nico"]

    lists = ("ALL_TASKS", "EXTRA", "NO_REWARD_VIZ")
    before = {name: others(name) for name in lists}
    domains = {name: tasks for name, tasks in suite.TASKS_BY_DOMAIN.items() if name != "nico"}

    nico.add_task("own", type("Own", (nico.NicoTask,), {}))
    nico.register()

    tasks = tuple(nico.TASKS)
    assert set(tasks) >= {*nico.ALL_TASKS, "own"}
    for name in lists:
        listed = getattr(suite, name)
        assert [pair for pair in listed if pair[0] == "nico"] == [("nico", task) for task in tasks]
        assert others(name) == before[name]
        assert [domain for domain, _ in listed] == sorted(domain for domain, _ in listed)
    assert {**domains, "nico": tasks} == suite.TASKS_BY_DOMAIN


def test_torchrl_finds_and_checks_registered_tasks(registered, renderer):
    assert {*nico.ALL_TASKS} <= {*dict(DMControlEnv.available_envs)["nico"]}
    env = DMControlEnv("nico", "push_white_left", observation="both", renderer=renderer)
    check_env_specs(env)


# An unbounded state is no mistake; the windows it would open are not ours.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*imum value is:UserWarning")
def test_gymnasiums_checks_pass_through_shimmy(renderer, monkeypatch):
    """Through Gymnasium's registry, since it checks registered environments further."""

    def make() -> gymnasium.Env:
        env = nico.load("push_white_left", observation="both", renderer=renderer)
        return DmControlCompatibilityV0(env)

    monkeypatch.setattr(gymnasium.envs.registration, "registry", {})
    gymnasium.register("nico-v0", make)
    env = gymnasium.make("nico-v0").unwrapped
    check_env(env, skip_render_check=True)
    assert set(env.observation_space) == {"pixels", "privileged_state"}
