"""Tasks from outside the suite: from their registration to their rows in a run's CSV files."""

import json

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.evaluation import evaluate_random_policy
from bgpo_trl.scenes.nico import NicoEnv
from suites import nico
from tests.helpers import finish


class AtOnce(nico.NicoTask):
    """Success: a step has passed."""

    def succeeded(self, physics):
        return physics.time() > 0


@pytest.fixture(autouse=True)
def added():
    """Add a task for the time of a test."""
    nico.add_task("at_once", AtOnce)


class TooFar(nico.NicoTask):
    """No success: episodes end after two steps as failures, with a reward for each step."""

    def succeeded(self, physics):
        return False

    def get_reward(self, physics):
        return super().get_reward(physics) - 0.5

    def get_termination(self, physics):
        return 0.0 if physics.time() > 0.3 else super().get_termination(physics)


def bank_of(*tasks, n=6):
    """Return a bank whose embeddings are the number of the task and of the demonstration."""
    task = torch.arange(len(tasks)).repeat_interleave(n)
    embedding = torch.stack([task.float(), torch.arange(len(task)).float()], -1)
    return DemonstrationBank(embedding, task, torch.arange(len(task)) % 3 > 0, tasks)


def test_an_added_task_can_be_loaded_by_name():
    assert tuple(nico.TASKS)[:3] == nico.PAPER_TASKS
    env = nico.load("at_once", seed=0, observation="state")
    env.reset()
    timestep = env.step(np.zeros(4))
    assert (timestep.last(), timestep.reward, timestep.discount) == (True, 1.0, 0.0)

    batch = NicoEnv(("grasp_glass", "at_once"), batch_size=[2], observation="state", seed=0)
    state = batch.reset(TensorDict({"task": torch.tensor([0, 1])}, [2]))
    state = batch.step(state.set("action", torch.zeros(2, 4)))["next"]
    assert state["terminated"].flatten().tolist() == [False, True]
    assert state["reward"].flatten().tolist() == [0, 1]
    rate = evaluate_random_policy(tasks=("grasp_glass", "at_once"), episodes=3, max_steps=2)
    assert rate.tolist() == [0, 1]


def test_a_task_may_end_episodes_without_success_and_reward_each_step():
    nico.add_task("too_far", TooFar)
    short, failing = (
        nico.load("too_far", seed=0, time_limit=t, observation="state") for t in (0.2, 9)
    )
    for env, discounts in ((short, [1.0]), (failing, [1.0, 0.0])):
        env.reset()
        timesteps = [env.step(np.zeros(4)) for _ in discounts]
        assert [(t.reward, t.discount) for t in timesteps] == [(-0.5, d) for d in discounts]
        assert timesteps[-1].last()

    batch = NicoEnv(["too_far"], observation="state", seed=0)
    after = batch.rollout(5)["next"]
    assert after["terminated"].flatten().tolist() == [False, True]
    assert not after["success"].any() and not after["reward"].any()


def test_bad_names_and_classes_of_tasks_are_refused():
    before = dict(nico.TASKS)
    names = ("grasp_glass", "at/once", "", "all")
    for name, task in (*((name, AtOnce) for name in names), ("juggle", object)):
        with pytest.raises(ValueError, match=r"cannot be called|must be a subclass"):
            nico.add_task(name, task)
    assert dict(nico.TASKS) == before


def test_a_run_is_resumed_with_its_demonstrations_from_whatever_module(
    begin, make_config, tmp_path
):
    config = make_config("state", "oracle", tasks=("at_once",), task_starts=(0,), episodes=4)
    parts = {"encoders": None, "resume": True}
    for module in ("my_tasks", "renamed"):
        nico.add_task("at_once", type("Renamed", (AtOnce,), {"__module__": module}))
        finish(begin(tmp_path, config, bank=bank_of("at_once"), **parts))
        stored = json.loads((tmp_path / "config.json").read_text())
        assert stored["task_modules"] == {"at_once": module}
    with begin(tmp_path, config, bank=bank_of("at_once") + bank_of("grasp_glass"), **parts):
        pass  # Demonstrations of tasks that are not in the run do not matter.
    with pytest.raises(ValueError, match="other settings"):
        begin(tmp_path, config, bank=bank_of("at_once", n=7), **parts)


@pytest.mark.parametrize("task", ["juggle", "at_once"])
def test_a_run_of_a_task_unknown_or_never_shown_is_refused_before_it_writes(
    begin, make_config, tmp_path, refused, task
):
    config = make_config("state", "oracle", tasks=(task,), task_starts=(0,))
    parts = {"bank": bank_of(*nico.PAPER_TASKS), "encoders": None}
    refused(lambda: begin(tmp_path / "run", config, **parts), f"'{task}'", "")
