"""Mistakes of an own scene that no single value betrays."""

import numpy as np
import pytest

from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.scenes import Outcome, RobotEnv, find_scene
from bgpo_trl.scenes.check import check_scene
from tests.scenes.dot import Dot, scene


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
    ],
)
def test_doubts(make, doubts, tmp_path):
    found = check_scene(scene(make))
    assert len(found) == len(doubts)
    assert all(doubt in line for doubt, line in zip(doubts, found, strict=True))
    if doubts and make is not Deaf:  # whose demonstrator does not succeed
        with pytest.warns(UserWarning) as warned:
            record_demonstrations(
                tmp_path, scene=scene(make), per_task=2, held_out_per_task=1, progress=False
            )
        assert [str(line.message) for line in warned] == [f"the scene 'dot': {x}" for x in found]


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (Unseeded, r"two episodes of 'left' with one seed begin differently: Unseeded.seed\(\)"),
        (Shared, "and in its own simulation only"),
        (Solved, "'left' has succeeded after one step without movement"),
    ],
)
def test_what_is_wrong_is_not_recorded(make, reason, tmp_path):
    with pytest.raises(ValueError, match=reason):
        record_demonstrations(tmp_path, scene=scene(make), progress=False)
    assert not [*tmp_path.iterdir()]


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
