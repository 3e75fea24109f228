"""One physical robot as an environment, with a dot whose motor moves by .2 of what it can."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from bgpo_trl.data.dataset import load_demonstrations, write_demonstrations
from bgpo_trl.runs.results import read_table
from bgpo_trl.scenes import SCENES, Outcome, RobotEnv, SimulationEnv
from bgpo_trl.scenes.check import check_scene
from tests.helpers import finish, spied
from tests.scenes.dot import (
    SHAPE,
    TASKS,
    SavedDot,
    pretrain,
    record_some,
    run_config,
    scene,
    trainer_of,
)

LIMIT = np.float32(0.2)


class Limited(SavedDot):
    """Executes at most a fifth of the largest action."""

    def step(self, action):
        executed = np.clip(action, -0.2, 0.2)
        return super().step(executed)._replace(executed=executed)


def robot_scene(make=Limited, **changes):
    return scene(make, env=RobotEnv, **changes)


def stepped(env, action):
    state = env.reset()
    state["action"] = torch.full((*env.batch_size, 1), action)
    return env.step(state)["next"]


def test_the_environment_returns_the_executed_action():
    check_env_specs(RobotEnv(Limited, TASKS, batch_size=[1], **SHAPE))
    env = robot_scene().simulate(TASKS, batch_size=[1])
    assert stepped(env, 0.7)["executed_action"].tolist() == [[LIMIT]]
    assert stepped(env, -0.1)["executed_action"].tolist() == [[np.float32(-0.1)]]
    assert env.reset()["executed_action"].tolist() == [[0.0]]
    free = RobotEnv(SavedDot, TASKS, batch_size=[1], **SHAPE)  # executes what it is told
    assert stepped(free, 0.7)["executed_action"].tolist() == [[np.float32(0.7)]]


@pytest.mark.parametrize("wrong", [[0.1, 0.2], [1.5], [float("nan")], ["fast"]])
def test_executed_actions_that_are_none_are_refused(wrong):
    class Wrong(SavedDot):
        def step(self, action):
            return Outcome(success=False, executed=wrong)

    with pytest.raises(ValueError, match=r"Wrong.step\(\) returned the executed action"):
        stepped(robot_scene(Wrong).simulate(TASKS), 0.1)


def test_executed_actions_are_not_lost_in_an_environment_of_simulations():
    with pytest.raises(ValueError, match=r"leave Outcome\.executed out"):
        stepped(SimulationEnv(Limited, TASKS, **SHAPE), 0.7)
    with pytest.raises(ValueError, match=r"leave Outcome\.executed out"):
        check_scene(scene(Limited))


def test_after_an_emergency_stop_the_episode_is_over():
    class Stops(SavedDot):
        def step(self, action):
            if action > 0.5:
                raise RuntimeError("stopped by hand")
            return super().step(action)

    env = robot_scene(Stops).simulate(TASKS)
    with pytest.raises(RuntimeError, match="stopped by hand"):
        stepped(env, 0.7)
    with pytest.raises(ValueError, match="reset the environment first"):
        env.step(env.rand_action())
    assert not stepped(env, 0.1)["done"]


def test_recordings_hold_the_executed_actions(tmp_path):
    shown = record_some(tmp_path, robot_scene())  # whose demonstrator asks for .3
    actions = shown["action"][torch.arange(12) < shown["length"][:, None] - 1]
    assert float(actions.abs().max()) == LIMIT


def test_a_run_without_tests_learns_from_what_was_executed(tmp_path, monkeypatch):
    robot = robot_scene()
    monkeypatch.setitem(SCENES, "dot", robot)
    pretrained = pretrain(robot, tmp_path)
    config = run_config(seeds=(3,), eval_episodes=0)
    with trainer_of(tmp_path / "run", pretrained, config) as trainer:
        acted = spied(trainer.algorithm, "act")
        trainer.run()
        held, _ = trainer.algorithm.replay.contents(0)
    asked = torch.cat([chosen["action"] for _, chosen in acted])
    assert asked.abs().max() > LIMIT
    torch.testing.assert_close(held["action"], asked.clamp(-LIMIT, LIMIT))
    assert not len(read_table(tmp_path / "run" / "eval.csv"))
    longer = replace(config, episodes=6)  # the dot, unlike most robots, can be saved
    finish(trainer_of(tmp_path / "run", pretrained, longer, resume=True))


def test_several_robots_are_refused_in_one_line(refused):
    refused(
        lambda: robot_scene().simulate(TASKS, batch_size=[2]),
        "there is one robot, and 2 are asked for",
        "train one seed (seeds=(0,)), without tests (eval_episodes=0)",
    )


@pytest.mark.parametrize(
    "changed",
    [
        {"setup": {"camera": "side", "units": "0.5 m/s"}},
        {"setup": {"camera": "top", "units": "0.4 m/s"}},
        {"setup": {"camera": "top"}},
        {"setup": {}},
        {"rate": 10.0},
    ],
)
def test_data_and_encoders_of_another_setup_are_refused(tmp_path, monkeypatch, refused, changed):
    told = {"setup": {"camera": "top", "units": "0.5 m/s"}, "rate": 5.0}
    robot = robot_scene(**told)
    monkeypatch.setitem(SCENES, "dot", robot)
    assert robot.identity == "dot dot-1 (camera: top; rate: 5.0; units: 0.5 m/s)"
    frames = np.zeros((3, 16, 24, 3), np.uint8)
    episodes = {name: [{"pixels": frames}] * 2 for name in TASKS}
    path = tmp_path / "shown"
    write_demonstrations(path, episodes, scene="dot", held_out_per_task=1)
    load_demonstrations(path)
    robot.check_identity(robot_scene(**told).identity, "the file", "train")

    other = robot_scene(**{**told, **changed})
    monkeypatch.setitem(SCENES, "dot", other)
    refused(lambda: load_demonstrations(path), robot.full_version, other.full_version)
    refused(
        lambda: other.check_identity(robot.identity, "the file", "train anew"),
        f"the file is of the scene {robot.identity}, this is {other.identity}",
        "train anew",
    )
    refused(
        lambda: other.check_identity(None, "the file", "train anew"),
        f"the file names no scene, this is {other.identity}",
        "train anew",
    )


def test_a_setup_is_words_and_leaves_the_rate_to_the_scene():
    assert robot_scene(rate=3.0).identity == "dot dot-1"
    for wrong in ({"camera": ""}, {"units": 3}, {"camera": "a\nb"}, {"rate": "5"}):
        with pytest.raises(ValueError, match="setup"):
            robot_scene(setup=wrong)
