"""The success condition of each task, in constructed states."""

from collections.abc import Sequence

import numpy as np
import pytest

from suites import nico
from suites.nico import kinematics
from suites.nico.nico import TASKS
from suites.nico.physics import OBJECT_HALF_HEIGHT, TABLE_HEIGHT, Physics

STANDING = (1.0, 0.0, 0.0, 0.0)
LYING = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)  # about x, so that the axis of the glass is along y
AWAY = {"glass": (0.45, 0.4), "green_box": (0.45, 0.1), "white_box": (0.45, -0.4)}


def succeeded(task: str, physics: Physics) -> bool:
    return TASKS[task](random=0).succeeded(physics)


def place(
    physics: Physics,
    objects: dict[str, Sequence[float]] | None = None,
    *,
    arm: Sequence[float] | np.ndarray = (0.0, -1.5, 0.0),  # stretched out backwards
    curls: Sequence[float] = (0.0, 0.0, 0.0),
    closing: float = 0.0,
) -> None:
    """Put objects at ``[x, y]`` or ``[x, y, z, *quaternion]``, the others apart from each other.

    Thumb, upper and lower finger take their curls (rad); targets lie ``closing`` (rad) beyond.
    """
    with physics.reset_context():
        for name, (x, y) in AWAY.items():
            height = TABLE_HEIGHT + OBJECT_HALF_HEIGHT[name]
            physics.named.data.qpos[name] = [x, y, height, *STANDING]
        for name, pose in (objects or {}).items():
            physics.named.data.qpos[name][: len(pose)] = pose
        physics.data.qpos[:12] = [*arm, *np.repeat(curls, 3)]
        physics.data.ctrl[:] = [*arm, *(np.array(curls) + closing)]
    physics.begin_episode()


def move(physics: Physics, name: str, pose: Sequence[float] | np.ndarray) -> None:
    """Move an object during an episode, to a pose as for `place`."""
    physics.named.data.qpos[name][: len(pose)] = pose
    physics.forward()


@pytest.mark.parametrize("target", ["glass", "white_box"])
@pytest.mark.parametrize(("gap", "touches"), [(-0.001, True), (0.001, True), (0.003, False)])
def test_push_is_done_when_the_green_box_touches_the_target(physics, target, gap, touches):
    # Half the box and the radius of the glass, or half the other box.
    place(physics, {"green_box": (0.40, 0.0), target: (0.40 + 0.05 + gap, 0.0)})
    done = {task for task in nico.PAPER_TASKS if succeeded(task, physics)}
    task = {"glass": "push_green_to_glass", "white_box": "push_green_to_white"}[target]
    assert done == ({task} if touches else set())


def test_push_to_white_measures_from_surface_to_surface(physics):
    # A box turned by 45 degrees reaches half its diagonal, 0.0354 m.
    reach = 0.025 * np.sqrt(2)
    rotation = (np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8))
    for gap, touches in ((0.001, True), (0.004, False)):
        white = (0.40 + reach + 0.025 + gap, 0.0, TABLE_HEIGHT + 0.025, *rotation)
        place(physics, {"green_box": (0.40, 0.0), "white_box": white})
        assert succeeded("push_green_to_white", physics) is touches


@pytest.mark.parametrize(
    ("x", "y", "touches"), [(0.451, 0.0, True), (0.40, 0.061, True), (0.40, 0.064, False)]
)
def test_push_to_glass_also_counts_for_a_lying_glass(physics, x, y, touches):
    # Along x a lying glass is as wide as a standing one; along y it is 0.07 m long.
    glass = (x, y, TABLE_HEIGHT + 0.025, *LYING)
    place(physics, {"green_box": (0.40, 0.0), "glass": glass})
    assert succeeded("push_green_to_glass", physics) is touches


GRIP = np.array([0.42, 0.05, TABLE_HEIGHT + 0.045])
ARM = kinematics.inverse(GRIP)
GLASS = (GRIP[0], GRIP[1], TABLE_HEIGHT + 0.035, *STANDING)
CLOSED, OPEN = 0.7, 0.0


@pytest.mark.parametrize(
    ("thumb", "upper", "lower", "closing", "held"),
    [
        pytest.param(CLOSED, CLOSED, CLOSED, 0.1, True, id="held"),
        pytest.param(CLOSED, CLOSED, OPEN, 0.1, True, id="upper finger"),
        pytest.param(CLOSED, OPEN, CLOSED, 0.1, True, id="lower finger"),
        pytest.param(OPEN, OPEN, OPEN, 0.1, False, id="open"),
        pytest.param(CLOSED, OPEN, OPEN, 0.1, False, id="thumb only"),
        pytest.param(OPEN, CLOSED, CLOSED, 0.1, False, id="fingers only"),
        pytest.param(CLOSED, CLOSED, CLOSED, 0.025, True, id="just closing"),
        pytest.param(CLOSED, CLOSED, CLOSED, 0.015, False, id="hardly closing"),
        pytest.param(CLOSED, CLOSED, CLOSED, -0.1, False, id="opening"),
    ],
)
def test_grasp_needs_both_sides_of_a_closing_hand(physics, thumb, upper, lower, closing, held):
    place(physics, {"glass": GLASS}, arm=ARM, curls=(thumb, upper, lower), closing=closing)
    assert succeeded("grasp_glass", physics) is held


def test_the_palm_counts_as_the_thumb_side(physics):
    # Moved right, along the normal of the palm, until it overlaps the palm by half a millimetre.
    shift = (0.043 - 0.018 - 0.025 + 0.0005) * np.array([np.sin(ARM[0]), -np.cos(ARM[0])])
    glass = (*(GRIP[:2] + shift), *GLASS[2:])
    place(physics, {"glass": glass}, arm=ARM, curls=(OPEN, OPEN, OPEN), closing=0.1)
    assert not succeeded("grasp_glass", physics)
    place(physics, {"glass": glass}, arm=ARM, curls=(OPEN, 1.2 * CLOSED, 1.2 * CLOSED), closing=0.1)
    assert succeeded("grasp_glass", physics)


def test_grasp_needs_the_glass_in_the_hand(physics):
    lying_glass = (GRIP[0], GRIP[1], TABLE_HEIGHT + 0.025, *LYING)
    box = (GRIP[0], GRIP[1], TABLE_HEIGHT + 0.025)
    for objects, held in (({}, False), ({"green_box": box}, False), ({"glass": lying_glass}, True)):
        place(physics, objects, arm=ARM, curls=(CLOSED,) * 3, closing=0.1)
        assert succeeded("grasp_glass", physics) is held


@pytest.mark.parametrize(("radius", "degrees"), [(0.38, 25.0), (0.42, -13.0)])
@pytest.mark.parametrize(
    ("task", "name", "side"),
    [
        ("push_glass_right", "glass", -1),
        ("push_white_right", "white_box", -1),
        ("push_white_left", "white_box", 1),
    ],
)
def test_a_push_aside_counts_5_cm_along_the_arc_from_the_start(
    physics, task, name, side, radius, degrees
):
    place(physics, {name: kinematics.polar(radius, np.radians(degrees))})

    def moves(left: float, outward: float = 0.0) -> bool:
        there = radius + outward
        move(physics, name, kinematics.polar(there, np.radians(degrees) + left / there))
        return succeeded(task, physics)

    assert not moves(side * 0.049)
    assert moves(side * 0.051)
    assert moves(side * 0.051, outward=0.03)
    assert not moves(side * -0.051)
    assert not moves(0.0, outward=0.06)


@pytest.mark.parametrize(
    ("task", "name"), [("push_glass_right", "glass"), ("push_white_right", "white_box")]
)
def test_an_object_pushed_aside_must_stand_upright_on_the_table(physics, task, name):
    place(physics, {name: (0.42, 0.0)})
    height = TABLE_HEIGHT + OBJECT_HALF_HEIGHT[name]
    move(physics, name, (0.42, -0.08, height, *STANDING))
    assert succeeded(task, physics)
    move(physics, name, (0.42, -0.08, height + 0.01, *STANDING))
    assert not succeeded(task, physics)
    move(physics, name, (0.42, -0.08, TABLE_HEIGHT + 0.025, *LYING))
    assert not succeeded(task, physics)


@pytest.mark.parametrize(("aside", "counts"), [(0.049, True), (0.051, False)])
@pytest.mark.parametrize("other", ["green_box", "white_box"])
def test_a_push_aside_leaves_the_other_objects_where_they_stood(physics, other, aside, counts):
    places = {"glass": (0.42, 0.1), "green_box": (0.42, -0.1), "white_box": (0.42, -0.25)}
    place(physics, places)
    move(physics, "glass", (0.42, 0.03))
    x, y = places[other]
    move(physics, other, (x + aside, y))
    assert succeeded("push_glass_right", physics) is counts


@pytest.mark.parametrize(
    ("height", "closing", "lifted"), [(0.039, 0.1, False), (0.041, 0.1, True), (0.041, 0.0, False)]
)
def test_the_green_box_is_lifted_1_5_cm_above_the_table_in_a_closing_hand(
    physics, height, closing, lifted
):
    box = (GRIP[0], GRIP[1], TABLE_HEIGHT + height)  # whose center is 0.025 m high on the table
    place(physics, {"green_box": box}, arm=ARM, curls=(CLOSED,) * 3, closing=closing)
    assert succeeded("lift_green", physics) is lifted


@pytest.mark.parametrize(
    ("above", "curl", "pressed"),
    [
        pytest.param(-0.012, 0.85, True, id="fist on the box"),
        pytest.param(0.05, 0.85, False, id="fist above the box"),
        pytest.param(-0.012, 0.5, False, id="half-open hand on the box"),
    ],
)
def test_the_white_box_is_pressed_by_the_fist_on_its_top(physics, above, curl, pressed):
    top = np.array([0.42, -0.2, TABLE_HEIGHT + 0.05 + above])
    arm = kinematics.inverse(top, (0.02, 0.12))
    place(physics, {"white_box": top[:2]}, arm=arm, curls=(curl,) * 3)
    assert succeeded("press_white", physics) is pressed


def test_a_box_that_lies_on_the_hand_is_not_pressed(physics):
    box = np.array([0.42, -0.2, TABLE_HEIGHT + 0.2])
    arm = kinematics.inverse(box, (0.02, 0.12))
    found = set()
    for above in np.arange(0.03, 0.08, 0.005):
        place(physics, {"white_box": (*box[:2], box[2] + above)}, arm=arm, curls=(0.85,) * 3)
        found.add((physics.touching("hand", "white_box"), succeeded("press_white", physics)))
    assert found == {(True, False), (False, False)}
