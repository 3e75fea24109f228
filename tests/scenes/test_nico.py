"""NicoEnv against single environments of the suite, and its promises to TorchRL."""

import pickle
from copy import deepcopy

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import check_env_specs, step_mdp

from bgpo_trl.scenes.nico import NicoEnv
from suites import nico
from suites.nico.demonstrator import Demonstrator


def actions(env: NicoEnv, steps: int) -> torch.Tensor:
    """Return actions ``[steps, *B, 4]``."""
    generator = torch.Generator().manual_seed(0)
    return torch.rand(steps, *env.batch_size, 4, generator=generator) * 2 - 1


def run(env: NicoEnv, td: TensorDictBase, actions: torch.Tensor) -> TensorDict:
    """Return what the steps give, stacked along the first dimension."""
    steps = []
    for action in actions:
        td = env.step(td.set("action", action))
        steps.append(td["next"].clone())
        td = step_mdp(td)
    return torch.stack(steps)


def assert_equal(first: TensorDictBase, second: TensorDictBase) -> None:
    assert set(first.keys()) == set(second.keys())
    for key in first.keys():  # noqa: SIM118
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=0)


def same_physics(first: dict, second: dict) -> bool:
    pairs = zip(first["simulations"], second["simulations"], strict=True)
    return all(one["physics"].equal(other["physics"]) for one, other in pairs)


def task_td(*task: int) -> TensorDict:
    return TensorDict({"task": torch.tensor(task)}, [len(task)])


@pytest.mark.parametrize(
    ("batch_size", "observation"), [((), "pixels"), ((3,), "state"), ((2, 2), "both")]
)
def test_specs_pass_the_check_of_torchrl(batch_size, observation):
    check_env_specs(NicoEnv(batch_size=batch_size, observation=observation))


@pytest.mark.parametrize("spread", [0.4, 1.0])
def test_each_row_equals_the_environment_of_the_suite(spread):
    batch = NicoEnv(batch_size=[3], seed=6, spread=spread, observation="both")
    td = batch.reset(task_td(0, 1, 2))
    alone = [
        nico.load(task, seed=6 + row, spread=spread, observation="both")
        for row, task in enumerate(nico.PAPER_TASKS)
    ]
    timesteps = [env.reset() for env in alone]
    for action in actions(batch, 4):
        for row, timestep in enumerate(timesteps):
            np.testing.assert_array_equal(td["pixels"][row], timestep.observation["pixels"])
            state = timestep.observation["privileged_state"].astype(np.float32)
            np.testing.assert_array_equal(td["state"][row], state)
        td = batch.step(td.set("action", action))["next"]
        timesteps = [
            env.step(of_row.double().numpy()) for env, of_row in zip(alone, action, strict=True)
        ]


@pytest.mark.parametrize(
    "duplicate", [deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"]
)
def test_a_copy_continues_as_the_original(duplicate):
    env = NicoEnv(batch_size=[2], seed=3, observation="both", threads=2)
    td = run(env, env.reset(task_td(2, 1)), actions(env, 3))[-1].exclude("reward")
    other = duplicate(env)
    check_env_specs(duplicate(env))
    expected = run(env, td.clone(), actions(env, 5))
    starts = [env.reset() for _ in range(2)]
    env.close()  # The copy has a renderer and threads of its own ...
    assert_equal(run(other, td, actions(other, 5)), expected)
    for start in starts:  # ... and its random numbers.
        assert_equal(other.reset(), start)


def test_a_partial_reset_does_not_change_other_rows():
    env = NicoEnv(batch_size=[3], observation="both", seed=0)
    undisturbed = NicoEnv(batch_size=[3], observation="both", seed=0)
    steps = actions(env, 6)
    before = run(env, env.reset(), steps[:3])[-1].exclude("reward")
    run(undisturbed, undisturbed.reset(), steps[:3])

    reset = torch.tensor([[False], [True], [False]])
    task = torch.tensor([2, 1, 2])  # counts only where there is a reset
    after = env.reset(before.clone().update({"_reset": reset, "task": task}))

    assert_equal(after[[0, 2]].exclude("task"), before[[0, 2]].exclude("task"))
    assert (after["state"][1] != before["state"][1]).any()
    assert (after["pixels"][1] != before["pixels"][1]).any()
    rollout = run(env, after, steps[3:])
    assert rollout["task"].tolist() == [[0, 1, 0]] * 3
    expected = run(undisturbed, before, steps[3:])
    assert_equal(rollout[:, [0, 2]], expected[:, [0, 2]])


def test_rows_masked_out_of_a_step_do_not_move():
    env = NicoEnv(batch_size=[3], observation="both", seed=0)
    undisturbed = NicoEnv(batch_size=[3], observation="both", seed=0)
    start = env.reset()
    undisturbed.reset()
    first, second = actions(env, 2)

    mask = torch.tensor([True, False, True])
    masked = env.step(start.clone().update({"action": first, "_step": mask}))["next"]

    assert_equal(masked[[1]].exclude("reward"), start[[1]])
    assert masked["reward"][1] == 0
    expected = undisturbed.step(start.clone().set("action", first))["next"]
    assert_equal(masked[[0, 2]], expected[[0, 2]])
    # The masked row goes on as if that step had not been.
    late = env.step(step_mdp(TensorDict({"next": masked}, [3])).set("action", second))["next"]
    alone = NicoEnv(seed=1, observation="both")
    expected = alone.step(alone.reset().set("action", second[1]))["next"]
    assert_equal(late[1], expected)


def succeed(env: NicoEnv, row: int, td: TensorDictBase) -> TensorDictBase:
    """Demonstrate in one row, while others rest, until it succeeds; return the last step."""
    simulation = env.simulations[row].environment
    demonstrator = Demonstrator(simulation, seed=0)
    demonstrator.reset()
    for _ in range(60):
        action = torch.zeros(*env.batch_size, 4)
        action[row] = torch.from_numpy(demonstrator(None))
        td = env.step(td.set("action", action))["next"]
        if td["done"].any():
            return td
        td = td.exclude("reward")
    raise AssertionError("the demonstration failed")


def loaded(env: NicoEnv) -> NicoEnv:
    """Return a new environment with the state of another."""
    fresh = NicoEnv(batch_size=env.batch_size, observation=env.observation, seed=0)
    fresh.load_simulation_state(env.simulation_state())
    return fresh


@pytest.mark.parametrize("continued", [lambda env: env, deepcopy, loaded])
def test_success_terminates_only_its_row_which_stands_still_until_its_reset(continued):
    env = NicoEnv(batch_size=[2], seed=2, observation="both")
    last = succeed(env, 1, env.reset(task_td(0, 0)))
    assert last["reward"].tolist() == [[0.0], [1.0]]
    assert last["terminated"].tolist() == last["done"].tolist() == [[False], [True]]
    assert not last["truncated"].any()
    last, env = last.exclude("reward"), continued(env)
    for mask in ({}, {"_step": torch.ones(2, dtype=torch.bool)}):
        after = env.step(last.clone().update({"action": torch.full((2, 4), 0.5), **mask}))["next"]
        assert after["reward"].tolist() == [[0.0], [0.0]]
        assert after["done"].tolist() == [[False], [True]]
        assert after["pixels"][1].equal(last["pixels"][1])
        assert not after["state"][0].equal(last["state"][0])
    env.reset(last.clone().set("_reset", ~last["done"]))  # of the other row
    after = env.step(last.clone().set("action", torch.zeros(2, 4)))["next"]
    assert after["done"].tolist() == [[False], [True]]
    fresh = env.reset(TensorDict({"_reset": last["done"]}, [2]))
    assert not fresh["done"].any()
    assert not fresh["state"][1].equal(last["state"][1])


def test_episodes_have_no_time_limit_without_a_step_counter():
    env = NicoEnv(observation="state", seed=0)
    rollout = run(env, env.reset(), torch.zeros(60, 4))
    assert not rollout["done"].any()


def test_observations_and_saved_states_share_no_memory_with_the_environment():
    env = NicoEnv(batch_size=[2], observation="both", seed=0)
    kept, copies = [], []
    td = env.reset()
    state = env.simulation_state()
    saved = deepcopy(state)
    for action in actions(env, 4):
        kept.append(td)
        copies.append(td.clone())
        td = env.step(td.clone().set("action", action))["next"]
    env.reset(task_td(1, 1))
    for td, copy in zip(kept, copies, strict=True):
        assert_equal(td, copy)
    for key in ("task", "begun", "success", "failure"):
        assert state[key].equal(saved[key])
    assert same_physics(state, saved)
    assert_equal(TensorDict(state["current"]), TensorDict(saved["current"]))
    for key in ("pixels", "state", "done", "task"):
        td[key].fill_(1)
    after = env.step(TensorDict({"action": torch.zeros(2, 4)}, [2]))["next"]
    assert (after["pixels"] != 1).any()
    assert not after["done"].any()


def test_bad_tasks_and_actions_are_refused_before_any_row_changes():
    env = NicoEnv(batch_size=[2], observation="state", seed=0)
    td = env.reset(task_td(2, 0))
    before = env.simulation_state()
    for method, entries in (
        ("reset", {"task": torch.tensor([1, -1])}),
        ("reset", {"task": torch.tensor([1, 3])}),
        ("_reset", {"task": torch.tensor([0.0, 1.7])}),
        ("_reset", {"task": torch.zeros(2, 2, dtype=torch.int64)}),
        ("step", {"action": torch.tensor([[0.0] * 4, [0.0, 0.0, torch.nan, 0.0]])}),
    ):
        with pytest.raises(ValueError, match=r"must lie in|whole number|finite numbers"):
            getattr(env, method)(td.clone().update(entries))
    after = env.simulation_state()
    assert after["task"].tolist() == [2, 0]
    assert same_physics(before, after)


def test_a_row_without_an_episode_cannot_step():
    env = NicoEnv(batch_size=2, observation="state", seed=0)
    td = env.reset(TensorDict({"_reset": torch.tensor([True, False])}, [2]))
    before = env.simulation_state()
    td["action"] = torch.ones(2, 4)
    with pytest.raises(ValueError, match="reset the environment first"):
        env.step(td)
    assert same_physics(before, env.simulation_state())
    env.step(td.set("_step", torch.tensor([True, False])))


def test_a_state_of_another_environment_is_refused():
    env = NicoEnv(batch_size=[2], observation="state", seed=0)
    env.reset(task_td(0, 2))
    for other in (
        {"batch_size": [3], "observation": "state"},
        {"batch_size": [2], "observation": "pixels"},
        {"batch_size": [2], "observation": "state", "tasks": ["grasp_glass"]},
        {"batch_size": [2], "observation": "state", "tasks": nico.PAPER_TASKS[::-1]},
    ):
        with pytest.raises(ValueError, match="use the same"):
            NicoEnv(**other).load_simulation_state(env.simulation_state())


def test_results_do_not_depend_on_the_number_of_threads():
    def play(threads):
        env = NicoEnv(batch_size=[3], seed=5, observation="both", threads=threads)
        td, seen = env.reset(), []
        for step, action in enumerate(actions(env, 8)):
            td["action"] = action
            td["_step"] = torch.tensor([True, step % 3 > 0, True])
            td = env.step(td)["next"]
            seen.append(td.clone())
        return torch.stack(seen)

    alone = play(1)
    for threads in (2, 5):
        assert (play(threads) == alone).all()
