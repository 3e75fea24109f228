"""Whether successes last: those of demonstrators, and touches, throws and falls."""

import json
from dataclasses import replace
from functools import cache
from itertools import product

import aftermath
import numpy as np
import pytest
import torch
from aftermath import CRITERIA, AftermathArguments, Continuation, Row
from shared import play

from bgpo_trl.evaluation import start_seeds
from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.runs.results import read_table
from suites import nico
from tests.helpers import cells, edit

NUMBER = aftermath._NUMBER


@cache
def demonstrated(task):
    """A success of the demonstrator, played once."""
    episodes = aftermath.scripted_episodes((task,), [1, 2], 1, 50, "demonstrators")
    return next(episode for episode in episodes if episode.success)


@pytest.mark.parametrize("task", nico.ALL_TASKS)
def test_successes_of_demonstrators_last(task):
    holds, distance = CRITERIA[task].judge(Continuation(), demonstrated(task))
    low, high = {"gap": (-1, 0.005), "lift": (0.1, 1), "displacement": (0.03, 1)}[
        CRITERIA[task].distance
    ]
    assert holds and low < distance < high


def throw(physics):
    physics.named.data.qpos["glass"][:3] += [0.0, 0.3, 0.2]  # out of the hand's reach
    physics.named.data.qvel["glass"][2] = 12.0  # in the air until 2.4 s later


def apart(velocity, distance=0.0):
    def change(physics):
        away = physics.object_position("green_box") - physics.object_position("glass")
        away[2] = 0
        away /= np.linalg.norm(away)
        physics.named.data.qpos["green_box"][:3] += distance * away
        physics.named.data.qvel["green_box"][:3] += velocity * away
        raise_arm(physics)  # The hand is no longer in the way.

    return change


def topple(physics):
    physics.named.data.qpos["glass"][3:] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    physics.named.data.qpos["glass"][2] -= 0.01


def slide(physics):
    physics.named.data.qvel["glass"][0] = 3.0  # along the table, and off it
    raise_arm(physics)


def raise_arm(physics):
    physics.named.data.qpos["shoulder_pitch"] += 1.0
    physics.named.data.ctrl["shoulder_pitch"] += 1.0


@pytest.mark.parametrize(
    ("task", "shown", "change", "lasts"),
    [
        ("grasp_glass", "push_glass_right", lambda _: None, False),  # only touched
        ("grasp_glass", "push_glass_right", throw, False),
        ("push_green_to_glass", "push_green_to_glass", apart(0.0, 0.01), True),
        ("push_green_to_glass", "push_green_to_glass", apart(0.0, 0.025), False),
        ("push_green_to_glass", "push_green_to_glass", apart(1.0), False),  # they touch, and part
        ("push_glass_right", "push_glass_right", topple, False),
        ("push_glass_right", "push_glass_right", slide, False),
        ("push_white_right", "push_white_left", lambda _: None, False),
        ("press_white", "press_white", raise_arm, False),
    ],
)
def test_a_success_has_to_last(task, shown, change, lasts):
    then, episode = Continuation(), demonstrated(shown)
    physics = then.begin(episode.end)
    change(physics)
    assert CRITERIA[task].judge(then, replace(episode, end=physics.get_state())).holds == lasts


def test_an_object_that_comes_back_is_not_pushed_aside():
    pushed, then = demonstrated("push_white_left"), Continuation()

    def pull(physics):
        """Brings the box back, half of the way to where it stood."""
        start = Continuation().begin(pushed.start).object_position("white_box")
        physics.named.data.qpos["white_box"][:2] += start[:2]
        physics.named.data.qpos["white_box"][:2] /= 2
        raise_arm(physics)

    # Success with the box at its farthest; the box then returns while nothing is done.
    wait, then.act = then.act, lambda *_: pull(then.physics) or wait(*_)
    holds, displacement = CRITERIA["push_white_left"].judge(then, pushed)
    assert aftermath.stands(then.physics, "white_box")
    assert not holds and displacement > 0


def test_a_continuation_equals_the_environment():
    env = nico.load("press_white", seed=5, observation="state")
    env.reset()
    then = Continuation()
    then.begin(env.physics.get_state())
    for action in np.random.default_rng(0).uniform(-1, 1, (5, 4)):
        env.step(action)
        then.act(action, 1)
        np.testing.assert_array_equal(then.physics.get_state(), env.physics.get_state())


class Close(nico.NicoTask):
    """Success: the hand is a fist."""

    def succeeded(self, physics):
        return bool(physics.joint_angles()[3] > 0.6)


def test_episodes_of_a_policy_equal_those_of_its_actions(scripted_run):
    action = [0.0, 0.1, 0.0, 0.2]
    run = scripted_run(
        "close", Close, lambda state: torch.tensor(action).expand(*state[..., :4].shape)
    )
    found = aftermath.policy_episodes(run, 5)
    assert [episode.seed for episode in found] == [3] * 5 + [8] * 5
    expected = [
        episode
        for seed in (3, 8)
        for episode in play(
            ("close",), start_seeds(seed, NUMBER, (1, 5)), seed, lambda *_: lambda _: action, 6
        )
    ]
    physics = Continuation().physics
    for ours, theirs in zip(found, expected, strict=True):
        assert (ours.task, ours.seed, ours.success) == (theirs.task, theirs.seed, theirs.success)
        np.testing.assert_array_equal(ours.start, theirs.start)
        np.testing.assert_allclose(ours.end, theirs.end, atol=1e-6)
        physics.set_state(ours.end)
        assert ours.success == Close(random=0).succeeded(physics)
    assert 0 < sum(episode.success for episode in found) < 10


def test_own_tasks_need_a_criterion(monkeypatch):
    episode = replace(demonstrated("press_white"), task="juggle")
    with pytest.raises(ValueError, match="juggle"):
        aftermath.judge("policy", [episode])
    monkeypatch.setitem(CRITERIA, "juggle", CRITERIA["press_white"])
    (row,) = aftermath.judge("policy", [episode, replace(episode, success=False)])
    assert row[:5] == ("policy", episode.seed, "juggle", True, "gap")


def test_the_table_equals_that_by_hand():
    rows = [
        Row("policy", 0, "a", True, "lift", 0.3),
        Row("policy", 0, "a", False, "lift", 0.01),
        Row("policy", 1, "a", True, "lift", 0.2),
        Row("policy", 1, "b", False, "gap", -0.0001),
        Row("random", 1, "b", True, "gap", 0.01),
    ]
    played = {"policy": {"a": 4, "b": 4}, "random": {"a": 4, "b": 5}}
    assert aftermath.aftermath_table(rows, played)[1:] == [
        ["policy", "a", "3 of 4", "66.7", "20.0 (lift)"],
        ["policy", "b", "1 of 4", "0.0", "0.0 (gap)"],
        ["random", "a", "0 of 4", "", ""],
        ["random", "b", "1 of 5", "100.0", "1.0 (gap)"],
    ]


def test_the_command_has_a_row_for_each_success(run_of, tmp_path):
    """Of the demonstrators' successes, since untrained policies have none."""
    run, out = run_of("oracle"), tmp_path / "out"
    algorithm = json.loads((run / "config.json").read_text())["algorithm"]
    edit(run / "config.json", algorithm={**algorithm, "max_steps": 50})
    state = load_checkpoint(run / "checkpoint")
    state["settings"]["algorithm"]["max_steps"] = 50
    save_checkpoint(run / "checkpoint", state)
    arguments = AftermathArguments(run=run, demonstrators=True, episodes=1, out=out)
    table = cells(aftermath.aftermath(arguments))[1:]
    actors = ("policy", "demonstrators", "random actions")
    assert [tuple(row[:2]) for row in table] == [*product(actors, nico.PAPER_TASKS)]
    rows = read_table(out / "aftermath.csv")
    for actor, task, successes, *_ in table:
        found = rows[(rows["actor"] == actor) & (rows["task"] == task)]
        assert successes == f"{len(found)} of 2"
    assert (rows["actor"] == "demonstrators").sum() >= 4
    assert set(json.loads((out / "aftermath.json").read_text())) == {"commit", "command"}


def test_demonstrators_and_random_actions_start_alike_without_a_run(monkeypatch):
    monkeypatch.setattr(nico, "ALL_TASKS", ("press_white",))
    episodes = aftermath.episodes_of(AftermathArguments(demonstrators=True, episodes=1, seeds=(4,)))
    assert list(episodes) == ["demonstrators", "random actions"]
    (first,), (second,) = episodes.values()
    assert (first.start == second.start).all()
    assert first.seed == second.seed == 4
