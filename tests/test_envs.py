"""NicoEnv against single environments of the suite, and its promises to TorchRL."""

import itertools
import pickle
import threading
import time
from copy import deepcopy
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import (
    RewardClipping,
    RewardScaling,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
    step_mdp,
)

from bgpo_trl.envs import NicoEnv
from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.modules.actor_critic import Actor
from suites import nico
from suites.nico.demonstrator import Demonstrator

batch_sizes = pytest.mark.parametrize("batch_size", [(), (3,), (2, 2)])
observations = pytest.mark.parametrize("observation", ["pixels", "state", "both"])


def actions(env: NicoEnv, steps: int, seed: int = 0) -> torch.Tensor:
    """Returns actions ``[steps, *B, 4]``."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(steps, *env.batch_size, 4, generator=generator) * 2 - 1


def run(env: NicoEnv, td: TensorDictBase, actions: torch.Tensor) -> TensorDict:
    """Returns what the steps give, stacked along the first dimension."""
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


def task_td(*task: int) -> TensorDict:
    return TensorDict({"task": torch.tensor(task)}, [len(task)])


@batch_sizes
@observations
def test_torchrl_finds_the_specs_kept(batch_size, observation):
    check_env_specs(NicoEnv(batch_size=batch_size, observation=observation))


@pytest.mark.parametrize("task", nico.ALL_TASKS)
def test_torchrl_finds_the_specs_of_every_task_kept(task):
    check_env_specs(NicoEnv([task], observation="both"))


@batch_sizes
def test_shapes_and_types(batch_size):
    env = NicoEnv(batch_size=batch_size, observation="both")
    start = env.reset()
    end = env.rand_step(start.clone())["next"]

    for td in (start, end):
        assert (td["pixels"].shape, td["pixels"].dtype) == ((*batch_size, 32, 64, 3), torch.uint8)
        assert (td["state"].shape, td["state"].dtype) == ((*batch_size, 16), torch.float32)
        assert (td["task"].shape, td["task"].dtype) == (batch_size, torch.int64)
        for key in ("done", "terminated", "truncated"):
            assert (td[key].shape, td[key].dtype) == ((*batch_size, 1), torch.bool)
    assert (end["reward"].shape, end["reward"].dtype) == ((*batch_size, 1), torch.float32)


@pytest.mark.parametrize("task", range(3))
def test_it_shows_what_the_suite_shows(task):
    env = NicoEnv(seed=5, observation="both")
    td = env.reset(TensorDict({"task": torch.tensor(task)}))
    plain = nico.load(nico.PAPER_TASKS[task], seed=5, observation="both")
    timestep = plain.reset()

    for action in actions(env, 6):
        np.testing.assert_array_equal(td["pixels"], timestep.observation["pixels"])
        state = timestep.observation["privileged_state"].astype(np.float32)
        np.testing.assert_array_equal(td["state"], state)
        td = env.step(td.set("action", action))["next"]
        timestep = plain.step(action.double().numpy())


def test_each_row_of_a_batch_is_as_it_is_alone():
    batch = NicoEnv(batch_size=[2, 2], seed=4, observation="both")
    steps = actions(batch, 5)
    tasks = torch.tensor([[0, 1], [2, 1]])
    start = batch.reset(TensorDict({"task": tasks}, [2, 2]))
    rollout = run(batch, start.clone(), steps)

    for row, index in enumerate(itertools.product(range(2), range(2))):
        alone = NicoEnv(seed=4 + row, observation="both")
        alone_start = alone.reset(TensorDict({"task": tasks[index]}))
        assert_equal(alone_start, start[index])
        assert_equal(run(alone, alone_start, steps[:, *index]), rollout[:, *index])


@pytest.mark.parametrize("spread", [0.0, 0.4])
def test_with_a_spread_each_row_is_the_suites_environment(spread):
    tasks = (0, 2)
    batch = NicoEnv(batch_size=[2], seed=6, spread=spread, observation="both")
    td = batch.reset(task_td(*tasks))
    alone = [
        nico.load(nico.PAPER_TASKS[task], seed=6 + row, spread=spread, observation="both")
        for row, task in enumerate(tasks)
    ]
    timesteps = [env.reset() for env in alone]
    whole = NicoEnv(batch_size=[2], seed=6, observation="state").reset(task_td(*tasks))
    assert (td["state"] != whole["state"]).any(dim=-1).all()

    for action in actions(batch, 4):
        for row, timestep in enumerate(timesteps):
            np.testing.assert_array_equal(td["pixels"][row], timestep.observation["pixels"])
            state = timestep.observation["privileged_state"].astype(np.float32)
            np.testing.assert_array_equal(td["state"][row], state)
        td = batch.step(td.set("action", action))["next"]
        timesteps = [
            env.step(of_row.double().numpy()) for env, of_row in zip(alone, action, strict=True)
        ]


class Patient(nico.NicoTask):
    """Success: three steps have passed."""

    steady_steps = 3

    def succeeded(self, physics):
        return physics.time() > 0


def test_success_that_has_to_last_is_counted_row_by_row_and_saved():
    nico.add_task("patient", Patient)

    def make_env():
        return NicoEnv(["patient"], batch_size=[2], seed=1, observation="state")

    def step(env, *rows):
        still = TensorDict({"action": torch.zeros(2, 4), "_step": torch.tensor(rows)}, [2])
        return env.step(still)["next"]["terminated"].flatten().tolist()

    env = make_env()
    env.reset()
    assert step(env, True, False) == [False, False]
    assert step(env, True, True) == [False, False]
    saved = env.simulation_state()
    other = make_env()
    other.load_simulation_state(saved)
    for continued in (env, deepcopy(other), other):
        assert step(continued, True, True) == [True, False]
        continued.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
        assert step(continued, True, True) == [False, True]


def test_seeds_can_be_given_one_by_one_and_set_again():
    env = NicoEnv(batch_size=[2], seed=[8, 3], observation="state")
    first = env.reset()
    env.set_seed(8)
    second = env.reset()

    torch.testing.assert_close(first["state"][0], second["state"][0], rtol=0, atol=0)
    other = NicoEnv(batch_size=[2], seed=8, observation="state").reset()
    assert_equal(other, second)
    assert (first["state"][1] != second["state"][1]).any()


@pytest.mark.parametrize(("seed", "same"), [(np.int64(3), 3), (np.array([3, 4]), 3)])
def test_seeds_may_be_of_numpy(seed, same):
    env, other = (NicoEnv(batch_size=2, seed=s, observation="state") for s in (seed, same))
    assert_equal(env.reset(), other.reset())


def test_without_a_seed_every_start_is_another():
    first, second = (NicoEnv(batch_size=2, seed=None, observation="state") for _ in range(2))
    starts = torch.cat([first.reset()["state"], second.reset()["state"]])
    first.set_seed(None)
    starts = torch.cat([starts, first.reset()["state"]])
    assert len(starts.unique(dim=0)) == 6


@pytest.mark.parametrize(("seed", "alike"), [(0, True), (None, False)])
def test_workers_draw_alike_from_the_default_seed_until_they_are_seeded(seed, alike):
    env = SerialEnv(2, partial(NicoEnv, seed=seed, observation="state"))
    first, second = env.reset()["state"]
    assert first.equal(second) == alike
    env.set_seed(0)
    first, second = env.reset()["state"]
    assert not first.equal(second)


def test_a_batch_size_may_be_a_number():
    assert NicoEnv(batch_size=2, observation="state").batch_size == (2,)


def test_the_largest_seed_can_be_set_for_a_batch():
    env = NicoEnv(batch_size=2, observation="state")
    env.set_seed(2**32 - 1)
    start = env.reset()["state"][1]
    assert start.equal(NicoEnv(seed=0, observation="state").reset()["state"])


@pytest.mark.parametrize(
    "duplicate",
    [deepcopy, lambda env: pickle.loads(pickle.dumps(env))],
    ids=["deepcopy", "pickle"],
)
def test_a_copy_continues_as_the_original_does(duplicate):
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


def test_a_copy_of_a_done_row_waits_for_its_reset():
    env = NicoEnv(batch_size=[2], seed=2, observation="state")
    last = succeed(env, 1, env.reset(task_td(0, 0))).exclude("reward")
    after = deepcopy(env).step(last.clone().set("action", torch.ones(2, 4)))["next"]
    assert after["done"].tolist() == [[False], [True]]
    assert after["state"][1].equal(last["state"][1])
    assert not after["state"][0].equal(last["state"][0])


def test_a_partial_reset_leaves_other_rows_alone():
    env = NicoEnv(batch_size=[3], observation="both")
    undisturbed = NicoEnv(batch_size=[3], observation="both")
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


def test_rows_masked_out_of_a_step_stay_where_they_are():
    env = NicoEnv(batch_size=[3], observation="both")
    undisturbed = NicoEnv(batch_size=[3], observation="both")
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


def test_no_row_at_all_may_step():
    env = NicoEnv(batch_size=[2], observation="state")
    start = env.reset()

    mask = torch.zeros(2, dtype=torch.bool)
    after = env.step(start.clone().update({"action": torch.ones(2, 4), "_step": mask}))["next"]

    assert_equal(after.select("state", "task", "done"), start.select("state", "task", "done"))


def test_the_task_is_chosen_at_reset_and_kept_until_another_is():
    env = NicoEnv(batch_size=[3], observation="state")
    assert env.reset()["task"].tolist() == [0, 0, 0]
    td = env.reset(task_td(2, 0, 1))
    assert td["task"].tolist() == [2, 0, 1]
    assert run(env, td, actions(env, 2))["task"].tolist() == [[2, 0, 1]] * 2
    assert env.reset()["task"].tolist() == [2, 0, 1]
    assert env.reset(task_td(1, 1, 1))["task"].tolist() == [1, 1, 1]


def succeed(env: NicoEnv, row: int, td: TensorDictBase) -> TensorDictBase:
    """Demonstrates in one row, while others rest, until it succeeds; returns the last step."""
    simulation = env._environments[row][int(env._task[row])]
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


@pytest.mark.parametrize("task", range(3))
def test_success_terminates_its_row_only(task):
    env = NicoEnv(batch_size=[2], seed=2, observation="state")
    last = succeed(env, 1, env.reset(task_td(task, task)))

    assert last["reward"].tolist() == [[0.0], [1.0]]
    assert last["terminated"].tolist() == last["done"].tolist() == [[False], [True]]
    assert not last["truncated"].any()


def test_a_done_row_waits_for_its_reset():
    env = NicoEnv(batch_size=[2], seed=2, observation="both")
    last = succeed(env, 1, env.reset(task_td(0, 0)))

    for mask in ({}, {"_step": torch.ones(2, dtype=torch.bool)}):
        td = last.exclude("reward").update({"action": torch.full((2, 4), 0.5), **mask})
        after = env.step(td)["next"]
        assert after["reward"].tolist() == [[0.0], [0.0]]
        assert after["done"].tolist() == [[False], [True]]
        torch.testing.assert_close(after["pixels"][1], last["pixels"][1], rtol=0, atol=0)
        assert (after["state"][0] != last["state"][0]).any()
    fresh = env.reset(TensorDict({"_reset": last["done"]}, [2]))
    assert not fresh["done"].any()
    assert (fresh["state"][1] != last["state"][1]).any()


def test_a_reset_elsewhere_leaves_a_row_done():
    env = NicoEnv(batch_size=[2], seed=2, observation="state")
    last = succeed(env, 1, env.reset(task_td(0, 0))).exclude("reward")

    env.reset(last.clone().set("_reset", torch.tensor([[True], [False]])))

    after = env.step(last.clone().set("action", torch.zeros(2, 4)))["next"]
    assert after["done"].tolist() == [[False], [True]]
    torch.testing.assert_close(after["state"][1], last["state"][1], rtol=0, atol=0)


def test_it_never_ends_an_episode_by_time():
    env = NicoEnv(observation="state")
    rollout = run(env, env.reset(), torch.zeros(60, 4))
    assert not rollout["done"].any()
    limited = TransformedEnv(env, StepCounter(50))
    last = limited.rollout(60, policy=lambda td: td.set("action", torch.zeros(4)))[-1]["next"]
    assert (last["truncated"].item(), last["terminated"].item()) == (True, False)
    assert last["step_count"] == 50


@pytest.mark.parametrize(
    ("transform", "paid"),
    [(RewardScaling(loc=-0.5, scale=4.0), (-0.5, 3.5)), (RewardClipping(0.1, 0.7), (0.1, 0.7))],
    ids=["scaling", "clipping"],
)
def test_rewards_can_be_scaled_and_clipped(transform, paid):
    env = TransformedEnv(NicoEnv(batch_size=[2], seed=2, observation="state"), transform)
    check_env_specs(env)
    last = succeed(env, 1, env.reset(task_td(0, 0)))
    torch.testing.assert_close(last["reward"].flatten(), torch.tensor(paid))
    assert env.reward_spec.is_in(last["reward"])


@batch_sizes
def test_it_continues_bit_for_bit_from_its_state(tmp_path, batch_size):
    env = NicoEnv(batch_size=batch_size, observation="both")
    steps = actions(env, 9)
    task = torch.arange(env.batch_size.numel()).reshape(batch_size) % 3
    td = run(env, env.reset(TensorDict({"task": task}, batch_size)), steps[:4])[-1]
    save_checkpoint(tmp_path, env.simulation_state())

    def go_on(env: NicoEnv) -> list[TensorDictBase]:
        first = run(env, td.exclude("reward"), steps[4:])
        start = env.reset()  # draws random numbers
        return [first, start.clone(), run(env, start, steps[:3])]

    expected = go_on(env)
    env.load_simulation_state(load_checkpoint(tmp_path))
    fresh = NicoEnv(batch_size=batch_size, seed=99, observation="both")
    fresh.load_simulation_state(load_checkpoint(tmp_path))

    for actual in (go_on(env), go_on(fresh)):
        for first, second in zip(actual, expected, strict=True):
            assert_equal(first, second)


def test_a_row_that_was_done_is_done_after_loading():
    env = NicoEnv(batch_size=[2], seed=2, observation="state")
    last = succeed(env, 1, env.reset(task_td(0, 0)))
    fresh = NicoEnv(batch_size=[2], observation="state")
    fresh.load_simulation_state(env.simulation_state())

    after = fresh.step(last.exclude("reward").set("action", torch.zeros(2, 4)))["next"]

    assert after["done"].tolist() == [[False], [True]]
    torch.testing.assert_close(after["state"][1], last["state"][1], rtol=0, atol=0)


def test_a_state_is_a_copy():
    env = NicoEnv(batch_size=[2], observation="both")
    td = env.reset(task_td(1, 2))
    state = env.simulation_state()
    physics, pixels = state["physics"].clone(), state["current"]["pixels"].clone()

    run(env, td, actions(env, 2))
    env.reset(task_td(0, 0))

    torch.testing.assert_close(state["physics"], physics, rtol=0, atol=0)
    torch.testing.assert_close(state["current"]["pixels"], pixels, rtol=0, atol=0)
    assert state["task"].tolist() == [1, 2]


@batch_sizes
def test_what_was_handed_out_never_changes(batch_size):
    env = NicoEnv(batch_size=batch_size, observation="both")
    kept, copies = [], []
    td = env.reset()
    for action in actions(env, 4):
        kept.append(td)
        copies.append(td.clone())
        td = env.step(td.clone().set("action", action))["next"]
    env.reset(TensorDict({"task": torch.ones(batch_size, dtype=torch.int64)}, batch_size))

    for td, copy in zip(kept, copies, strict=True):
        assert_equal(td, copy)
    td["pixels"].zero_()
    td["state"].zero_()
    td["done"].fill_(True)
    td["task"].fill_(2)
    after = env.step(TensorDict({"action": torch.zeros(*batch_size, 4)}, batch_size))["next"]
    assert after["pixels"].any()
    assert not after["done"].any()
    assert (after["task"] == 1).all()


@pytest.mark.parametrize("wrong", [-1, 3])
def test_a_task_out_of_range_is_refused_before_anything_changes(wrong):
    env = NicoEnv(batch_size=[2], observation="state")
    env.reset(task_td(2, 0))
    before = env.simulation_state()

    with pytest.raises(ValueError, match=rf"^task must lie in 0\.\.2, got \[1, {wrong}\]$"):
        env.reset(task_td(1, wrong))

    after = env.simulation_state()
    assert after["task"].tolist() == [2, 0]
    torch.testing.assert_close(after["physics"], before["physics"], rtol=0, atol=0)


def test_a_bad_action_is_refused_before_any_row_moves():
    env = NicoEnv(batch_size=[2], observation="state")
    td = env.reset()
    before = env.simulation_state()["physics"]
    action = torch.zeros(2, 4)
    action[1, 2] = torch.nan

    with pytest.raises(ValueError, match=r"^an action is 4 finite numbers in \[-1, 1\], got .*$"):
        env.step(td.set("action", action))

    torch.testing.assert_close(env.simulation_state()["physics"], before, rtol=0, atol=0)


def test_wrong_arguments_are_refused_in_one_line():
    with pytest.raises(ValueError, match=r"^3 seeds for 2 simulations: give one each$"):
        NicoEnv(batch_size=[2], seed=[1, 2, 3])
    with pytest.raises(ValueError, match=r"^no NICO task 'juggle'; choose one of .*$"):
        NicoEnv(["juggle"])
    with pytest.raises(ValueError, match=r"^observation is 'sound'; choose one of .*$"):
        NicoEnv(observation="sound")
    with pytest.raises(ValueError, match=r"^spread is 2: choose a number from 0 .* to 1$"):
        NicoEnv(spread=2)


def test_a_state_of_another_environment_is_refused():
    state = NicoEnv(batch_size=[2], observation="state").simulation_state()

    with pytest.raises(ValueError, match=r"^the state holds 2 simulations, .* has 3: use .*$"):
        NicoEnv(batch_size=[3], observation="state").load_simulation_state(state)
    with pytest.raises(ValueError, match=r"observations \['state'\], .* has \['pixels'\]: use"):
        NicoEnv(batch_size=[2], observation="pixels").load_simulation_state(state)


def test_results_do_not_depend_on_the_number_of_threads():
    def play(threads):
        env = NicoEnv(batch_size=[3], seed=5, observation="both", threads=threads)
        generator = torch.Generator().manual_seed(0)
        td, seen = env.reset(), []
        for step in range(12):
            td["action"] = torch.rand(3, 4, generator=generator) * 2 - 1
            td["_step"] = torch.tensor([True, step % 3 > 0, True])
            td = env.step(td)["next"]
            seen.append(td.clone())
        return torch.stack(seen)

    alone = play(1)
    for threads in (2, 5):
        together = play(threads)
        assert (together == alone).all()


def test_an_error_in_a_thread_reaches_the_caller_when_all_others_have_stopped(monkeypatch):
    env = NicoEnv(batch_size=[3], seed=0, observation="state", threads=2)
    td = env.reset()
    first, last = env._environments[0][0], env._environments[2][0]
    finished = []

    def fail(action):
        raise RuntimeError("physics exploded")

    def slow(action, step=last.step):
        time.sleep(0.05)
        finished.append(timestep := step(action))
        return timestep

    monkeypatch.setattr(first, "step", fail)
    monkeypatch.setattr(last, "step", slow)
    with pytest.raises(RuntimeError, match="physics exploded"):
        env.step(td.set("action", torch.zeros(3, 4)))
    assert len(finished) == 1


def test_without_a_thread_there_is_nothing_to_step_in():
    with pytest.raises(ValueError, match=r"^threads must be at least 1, or None for all cores.*$"):
        NicoEnv(threads=0)


def test_closing_ends_the_threads():
    env = NicoEnv(batch_size=[3], seed=0, threads=3)
    before = threading.active_count()
    env.rollout(2)
    assert before < threading.active_count() <= before + 2  # and the caller's own
    env.close()
    assert threading.active_count() == before


def test_the_frames_last_drawn_can_be_looked_at():
    env = NicoEnv(batch_size=[2, 1], seed=3)
    start = env.reset()
    shown = env.frames()
    assert (shown == start["pixels"].numpy()).all()
    after = env.rand_step(start)["next"]
    assert (shown == start["pixels"].numpy()).all()  # what was shown stays as it was
    assert (env.frames() == after["pixels"].numpy()).all()
    with pytest.raises(ValueError, match="observe 'both'"):
        NicoEnv(seed=3, observation="state").frames()


def test_a_policy_that_learns_may_act():
    actor = Actor(16, 4, in_keys=["state"])
    assert NicoEnv(observation="state").rollout(2, actor).shape == (2,)


def test_a_row_without_an_episode_cannot_step():
    env = NicoEnv(batch_size=2, observation="state", seed=0)
    td = env.reset(TensorDict({"_reset": torch.tensor([True, False])}, [2]))
    before = env.simulation_state()["physics"]
    td["action"] = torch.ones(2, 4)
    with pytest.raises(ValueError, match="reset the environment first"):
        env.step(td)
    assert env.simulation_state()["physics"].equal(before)
    env.step(td.set("_step", torch.tensor([True, False])))


def test_its_dtypes_do_not_depend_on_torchs_default():
    default = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float64)
        check_env_specs(NicoEnv(observation="state", seed=0))
    finally:
        torch.set_default_dtype(default)


@pytest.mark.parametrize("task", [torch.zeros(2, 2).long(), torch.tensor([0.0, 1.7])])
def test_a_task_is_a_whole_number_for_each_row(task):
    env = NicoEnv(batch_size=2, observation="state")
    with pytest.raises(ValueError, match="task must be a whole number for each of 2 simulations"):
        env._reset(SimpleNamespace(get={"task": task}.get))


def test_a_seed_a_row_is_needed_and_tasks_of_a_state_must_exist():
    env = NicoEnv(batch_size=2, observation="state", seed=0)
    with pytest.raises(ValueError, match="1 seeds for 2 simulations"):
        env.seed_rows([1])
    env.reset(TensorDict({"task": torch.tensor([0, 2])}, [2]))
    fewer = NicoEnv(["grasp_glass"], batch_size=2, observation="state", seed=0)
    with pytest.raises(ValueError, match="saved in task 2, this environment has 1 tasks"):
        fewer.load_simulation_state(env.simulation_state())
