"""Meta-World's tasks as a scene. Needs the package, which is not among our dependencies."""

import numpy as np
import pytest

from bgpo_trl.data.recording import record_demonstrations

pytest.importorskip("metaworld", reason="Meta-World is not installed (docs/extending.md)")

from examples.meta_world import FIVE, MetaWorld, demonstrator

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def worlds():
    return {}


@pytest.fixture
def simulation(worlds):
    return MetaWorld(worlds)


def act_at_random(simulation, steps, seed=0):
    random = np.random.default_rng(seed)
    return [simulation.step(random.uniform(-1, 1, 4)) for _ in range(steps)]


def assert_same(a, b):
    assert np.array_equal(a.observation, b.observation)
    assert np.array_equal(a.frame(), b.frame())


@pytest.mark.parametrize("task", FIVE)
def test_simulations_of_one_world_do_not_influence_each_other(simulation, worlds, task):
    beside, alone = MetaWorld(worlds), MetaWorld()
    for each, seed in ((simulation, 1), (beside, 2), (alone, 1)):
        each.seed(seed)
        each.reset(task)
    random = np.random.default_rng(0)
    for action in random.uniform(-1, 1, (6, 4)):
        simulation.step(action)
        beside.step(random.uniform(-1, 1, 4))
        alone.step(action)
        assert_same(simulation, alone)


@pytest.mark.parametrize("task", FIVE)
def test_a_saved_episode_continues_bit_by_bit(simulation, task):
    """Hence starts, each another one, depend on seed and episode alone."""
    simulation.seed(8)
    simulation.reset(FIVE[FIVE.index(task) - 2])
    simulation.reset(task)
    first = simulation.observation[4:7].copy()
    act_at_random(simulation, 9)
    resumed = MetaWorld()
    resumed.load(simulation.save())

    assert resumed.save() == simulation.save()
    for each in (simulation, resumed):
        act_at_random(each, 4, seed=1)
    assert_same(simulation, resumed)
    for each in (simulation, resumed):
        each.reset(task)
    assert_same(simulation, resumed)
    assert not np.array_equal(simulation.observation[4:7], first)


def test_a_simulation_saved_before_its_first_episode_keeps_its_seed(simulation):
    simulation.seed(5)
    resumed = MetaWorld()
    resumed.load(simulation.save())
    for each in (simulation, resumed):
        each.reset(FIVE[0])
    assert_same(simulation, resumed)


@pytest.mark.parametrize("task", FIVE)
def test_demonstrators_succeed_and_random_actions_do_not(simulation, task):
    solved, lucky = 0, 0
    for start in range(20):
        simulation.seed(start)
        simulation.reset(task)
        act = demonstrator(simulation, task, start)
        solved += any(simulation.step(act()).success for _ in range(50))
        simulation.reset(task)
        lucky += any(outcome.success for outcome in act_at_random(simulation, 50, start))
    assert solved >= 19
    assert lucky <= 2


def test_success_has_to_last_for_two_actions(simulation, monkeypatch):
    simulation.seed(0)
    simulation.reset(FIVE[0])
    reports = iter([False] * 3 + [True] * 4 + [False] * 4 + [True] + [False] * 3 + [True])

    def step(env, action):
        return simulation.observation, 0.0, False, False, {"success": next(reports)}

    monkeypatch.setattr(type(simulation.world.env), "step", step)
    outcomes = [simulation.step(np.zeros(4)).success for _ in range(4)]
    assert outcomes == [False, False, False, True]


def test_demonstrations_are_recorded(tmp_path):
    dataset = record_demonstrations(
        tmp_path, scene="metaworld", per_task=2, held_out_per_task=1, progress=False
    )
    assert dataset["task"].tolist() == [task for task in range(5) for _ in range(2)]
    assert (dataset["length"] > 10).all()
