"""State of a simulation, contacts and gaps."""

import itertools

import mujoco
import numpy as np
import pytest

from suites import nico
from suites.nico.demonstrator import Demonstrator
from suites.nico.physics import TABLE_HEIGHT, Physics
from tests.suites.nico.test_tasks import ARM, GRIP, place


@pytest.mark.parametrize("task", ["grasp_glass", "push_white_left"])
def test_a_simulation_continues_bit_for_bit_from_its_state(load, task):
    env = load(task, seed=0, observation="state")
    other = nico.load(task, seed=1, observation="state").physics
    demonstrator = Demonstrator(env, seed=0)
    timestep = env.reset()
    demonstrator.reset()
    contacts = 0
    # From every state, those with contacts of the hand included.
    while not timestep.last():
        other.set_state(env.physics.get_state())
        timestep = env.step(demonstrator(timestep))
        other.set_control(env.physics.data.ctrl)
        other.step(20)
        other.count_steady(env.task.succeeded(other))
        np.testing.assert_array_equal(env.physics.get_state(), other.get_state())
        contacts += env.physics.robot_touches()
    assert contacts


def test_a_reloaded_scene_is_queried_and_drawn_as_a_new_one():
    env = nico.load("grasp_glass", seed=0)
    before = env.reset().observation["pixels"]
    added = (
        '<body name="post" pos="0.3 0.3 0.7"><geom name="post" type="sphere" size="0.01"/></body>'
    )
    xml = (
        nico.scene_xml()
        .replace("<worldbody>", f"<worldbody>{added}")
        .replace('rgba=".85 .10 .12 1"', 'rgba=".1 .1 .9 1"')
    )
    env.physics.reload_from_xml_string(xml)
    env.task.random.seed(0)
    after = env.reset().observation["pixels"]
    fresh = nico.load("grasp_glass", seed=0, physics=Physics.from_xml_string(xml))
    np.testing.assert_array_equal(after, fresh.reset().observation["pixels"])
    assert (after != before).any()
    assert env.physics.gap("glass", "green_box") == fresh.physics.gap("glass", "green_box")
    assert env.physics.palm_position().tolist() == fresh.physics.palm_position().tolist()


def test_a_state_can_be_restored_within_a_reset(load):
    env = load("push_green_to_white", seed=0, observation="state")
    env.reset()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 4))
    for action in actions[10:]:
        env.step(action)
    state = env.physics.get_state()
    seen = [env.step(action).observation["privileged_state"] for action in actions[:10]]
    with env.physics.reset_context():
        env.physics.set_state(state)
    np.testing.assert_array_equal(env.physics.get_state(), state)
    again = [env.step(action).observation["privileged_state"] for action in actions[:10]]
    np.testing.assert_array_equal(again, seen)


def test_parts_of_the_state_can_be_chosen_and_have_their_length(physics):
    part = mujoco.mjtState.mjSTATE_QPOS.value
    with physics.reset_context():
        pass
    angles = physics.get_state(part)
    physics.set_state(angles + 0.01, part)
    np.testing.assert_array_equal(physics.data.qpos, angles + 0.01)
    with pytest.raises(ValueError, match="266 numbers"):
        physics.set_state(np.zeros(33))


@pytest.mark.parametrize("name", nico.OBJECTS)
def test_an_object_touched_by_the_palm_from_the_side_is_not_pressed(physics, name):
    place(physics, {name: (GRIP[0], GRIP[1], TABLE_HEIGHT + 0.03)}, arm=ARM, closing=0.1)
    assert physics.touching("palm", name)
    assert not physics.pressed(name)


def test_the_hand_ends_at_the_wrist(physics):
    place(physics, arm=ARM)
    place(physics, {"white_box": physics.named.data.geom_xpos["forearm"].copy()}, arm=ARM)
    assert physics.touching("forearm", "white_box")
    assert not physics.touching("hand", "white_box")


def test_the_gap_to_the_hand_is_that_to_its_nearest_part(physics):
    box = (0.42, -0.07, TABLE_HEIGHT + 0.03)
    place(physics, {"green_box": box}, arm=ARM, curls=(0.3,) * 3, closing=0.1)
    digits = ("thumb", "upper_finger", "lower_finger")
    parts = [f"{digit}_{n}" for digit, n in itertools.product(digits, (1, 2, 3))]
    gaps = [physics.gap(part, "green_box") for part in ("palm", "wrist", *parts)]
    assert 0.002 < min(gaps) < max(gaps)
    assert physics.gap("hand", "green_box") == physics.gap("green_box", "hand") == min(gaps)


def test_unknown_names_are_refused(physics):
    for query in (
        lambda: physics.gap("hand", "cup"),
        lambda: physics.touching("cup", "hand"),
        lambda: physics.held("palm"),  # a part of the robot, not an object
        lambda: physics.pressed("cup"),
        lambda: physics.object_position("cup"),
        lambda: physics.start_position("palm"),
        lambda: physics.stands("cup"),
    ):
        with pytest.raises(ValueError, match=r"no .*'(cup|palm)' .* one of .*white_box"):
            query()
