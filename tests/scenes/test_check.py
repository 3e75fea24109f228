"""Mistakes of an own scene that no single value betrays."""

import numpy as np
import pytest
import torch

from bgpo_trl.scenes import Outcome, RobotEnv, StateColumns, find_scene
from bgpo_trl.scenes.check import check_scene
from bgpo_trl.seeding import random_state
from tests.scenes.dot import Dot, SavedDot, record_some, scene


class Late(Dot):
    """Shows the moment before."""

    def reset(self, task):
        super().reset(task)
        self.shown = super().frame()

    def step(self, action):
        self.shown = super().frame()
        return super().step(action)

    def frame(self):
        return self.shown


class Consumed(Late):
    """Shows, each time it is asked, what there was when it was asked before."""

    step = Dot.step

    def frame(self):
        shown, self.shown = self.shown, Dot.frame(self)
        return shown


class AlwaysHere(Dot):
    def reset(self, task):
        super().reset(task)
        self.place = 0.0


class SeededAnew(Dot):
    def reset(self, task):
        self.random.seed(3)
        super().reset(task)


class Deaf(Dot):
    def step(self, action):
        return super().step(0 * action)


class Unseeded(Dot):
    def seed(self, seed):
        pass


class Shared(Dot):
    generator = np.random.RandomState(0)

    def __init__(self):
        super().__init__()
        self.random = self.generator


class Solved(Dot):
    def step(self, action):
        return Outcome(True)


class SolvedByTheSecondStep(SavedDot):
    steps = 0

    def reset(self, task):
        super().reset(task)
        self.steps = 0

    def step(self, action):
        self.steps += 1
        return Outcome(super().step(action).success or self.steps == 2)


class Misplaced(SavedDot):
    """Does not load the place."""

    def load(self, state):
        super().load(state | {"place": self.place})


class Redrawn(SavedDot):
    """Does not load what starts are drawn from."""

    def load(self, state):
        super().load(state | {"random": random_state(self.random)})


class Alias(SavedDot):
    """Saves a tensor that it goes on changing."""

    def reset(self, task):
        super().reset(task)
        self.place = torch.tensor(self.place)

    def frame(self):
        place, self.place = self.place, float(self.place)
        shown, self.place = super().frame(), place
        return shown


class Unsavable(SavedDot):
    """Saves what no checkpoint can hold."""

    def save(self):
        return super().save() | {"place": np.array(self.place)}


ALWAYS = "begin with the same frame "


@pytest.mark.parametrize(
    ("make", "doubts"),
    [
        (Dot, []),
        (Late, ["the frame after the first step is the same"]),
        (Consumed, ["frame() differs when called twice"]),
        (AlwaysHere, [ALWAYS + "with whatever seed", ALWAYS + "reset after reset"]),
        (SeededAnew, [ALWAYS + "with whatever seed", ALWAYS + "reset after reset"]),
        (Deaf, ["component 0 (from 0) of actions changes no frame"]),
        (SavedDot, []),
        (Misplaced, ["differently after load()"]),
        (Redrawn, ["differently after load()"]),
        (Alias, ["differently after load()"]),
        (Unsavable, ["runs could not be saved: save()['place'] is a ndarray"]),
        (
            SolvedByTheSecondStep,
            [f"'{task}' succeeds by actions of 0 alone" for task in ("left", "right")],
        ),
    ],
)
def test_doubts(make, doubts, tmp_path):
    found = check_scene(scene(make))
    assert len(found) == len(doubts)
    assert all(doubt in line for doubt, line in zip(doubts, found, strict=True))
    if doubts and make is not Deaf:  # whose demonstrator does not succeed
        with pytest.warns(UserWarning) as warned:
            record_some(tmp_path, scene(make))
        assert [str(line.message) for line in warned] == [f"the scene 'dot': {x}" for x in found]


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (Unseeded, "two episodes of 'left' with one seed begin differently: Unseeded.seed()"),
        (Shared, "and in its own simulation only"),
        (Solved, "'left' has succeeded after one step without movement"),
    ],
)
def test_what_is_wrong_is_not_recorded(make, reason, tmp_path, refused):
    refused(lambda: record_some(tmp_path, scene(make)), reason, "")


def test_joints_of_another_size_than_the_scene_says_are_refused():
    class Short(Dot):
        def joints(self):
            return [self.place]

    robot = scene(Short, joints=StateColumns(center=[0, 0], scale=[1, 1]))
    for call in (lambda: check_scene(robot), robot.simulate(["left"]).reset):
        with pytest.raises(ValueError, match=r"Short.joints\(\) returned .*: return 2 finite"):
            call()


def test_a_physical_robot_is_not_moved_and_its_connection_is_closed():
    moved, closed = [], []

    class Robot(Dot):
        def reset(self, task):
            moved.append(task)

        def close(self):
            closed.append(self)

    assert check_scene(scene(Robot, env=RobotEnv)) == []
    assert (moved, len(closed)) == ([], 1)


def test_nico_is_in_order():
    assert check_scene(find_scene("nico")) == []
