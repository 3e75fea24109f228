"""What is hidden from a policy, and what that does to one that looks and one that does not."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict

from bgpo_trl.envs import NicoEnv
from bgpo_trl.experiments import looking
from bgpo_trl.experiments.looking import HidingEnv, Row
from suites import nico
from suites.nico.rendering import FrameRenderer

GLASS_Y = 8  # of the state
VIEWS = ["seen", "places hidden", "objects hidden"]
every_kind = pytest.mark.parametrize("hidden", ["places", "objects"])


class Turn(nico.NicoTask):
    """Success: the arm has turned to one side, by default that to which the glass is displaced."""

    side = 0.0

    def initialize_episode(self, physics):
        super().initialize_episode(physics)
        self._yaw = physics.arm_angles()[0]
        y = physics.object_position("glass")[1] - nico.nominal_places()[0, 1]
        self._side = self.side or np.sign(y)

    def succeeded(self, physics):
        return bool(self._side * (physics.arm_angles()[0] - self._yaw) > 0.2)


class TurnLeft(Turn):
    """Success: the arm has turned to the left."""

    side = 1.0


def turn(yaw):
    return torch.nn.functional.pad(yaw.unsqueeze(-1), (0, 3))


def look(state):
    """Turns to the glass, as far as it is displaced."""
    return turn((30 * (state[..., GLASS_Y] - nico.nominal_places()[0, 1])).clamp(-1, 1))


def remember(state):
    """Turns to the left, whatever it sees."""
    return turn(torch.ones_like(state[..., 0]))


def by_condition(run, episodes=8):
    rows = looking.measure_looking(run, episodes)
    assert [(row.condition, row.seed) for row in rows] == [
        (condition, seed) for condition in [*VIEWS, looking.RANDOM] for seed in (3, 8)
    ]
    return {
        c: [row.success for row in rows if row.condition == c] for c in [*VIEWS, "random actions"]
    }


def test_a_policy_that_looks_is_lost_without_seeing(scripted_run):
    found = by_condition(scripted_run("turn", Turn, look))
    assert min(found["seen"]) > 0.5
    assert found["places hidden"] == found["objects hidden"] == [0, 0]


def test_a_remembered_movement_needs_no_eyes(scripted_run):
    found = by_condition(scripted_run("turn_left", TurnLeft, remember))
    assert found["seen"] == found["places hidden"] == found["objects hidden"]
    assert min(found["seen"]) > 0.5 > max(found["random actions"])


def test_the_starts_are_the_same_in_all_conditions(scripted_run):
    found = by_condition(scripted_run("turn", Turn, remember))
    assert found["seen"] == found["places hidden"] == found["objects hidden"]
    assert 0 < found["seen"][0] < 1 and found["seen"][0] != found["seen"][1]


def scene(physics, poses):
    """A frame and the state of the scene with the objects elsewhere, by a complete update."""
    other = nico.Physics.from_xml_string(nico.scene_xml())
    other.data.qpos[:] = physics.data.qpos
    for name, (place, turned) in zip(nico.OBJECTS, poses, strict=True):
        x, y, z, w = turned.as_quat()
        other.named.data.qpos[name] = [*place, w, x, y, z]
    other.forward()
    frame = FrameRenderer(other.model.ptr).render(other.data.ptr)
    return frame, other.privileged_state().astype(np.float32)


def poses(physics):
    found = [physics.named.data.qpos[name] for name in nico.OBJECTS]
    return [(pose[:3].copy(), Rotation.from_quat(pose[[4, 5, 6, 3]])) for pose in found]


def check(env, row, expected):
    frame, state = scene(env._environments[row][0].physics, expected)
    np.testing.assert_array_equal(env.frames()[row], frame)
    np.testing.assert_allclose(env._current["state"][row], state, atol=1e-6)


@every_kind
def test_what_is_shown_is_a_scene_with_nominal_places(hidden):
    env = HidingEnv(batch_size=[2], seed=4, observation="both", hidden=hidden)
    state = env.reset()
    nominal = [(place, Rotation.identity()) for place in nico.nominal_places()]
    for row in range(2):
        check(env, row, nominal)
    starts = [poses(tasks[0].physics) for tasks in env._environments]

    # The second glass is moved, turned and knocked over: what is shown follows, or does not.
    physics = env._environments[1][0].physics
    toppled = Rotation.from_euler("xz", [90, 40], degrees=True).as_quat()
    pose = [*(starts[1][0][0] + [0.03, 0.05, -0.01]), *toppled[[3, 0, 1, 2]]]
    physics.named.data.qpos["glass"] = pose
    physics.forward()
    for _ in range(3):
        state.set("action", torch.tensor([[0.0, 0.0, 0.5, 0.0]] * 2))
        state = env.step(state)["next"]
    for row, tasks in enumerate(env._environments):
        expected = nominal
        if hidden == "places":
            expected = [
                (place + now[0] - start[0], now[1] * start[1].inv())
                for (place, _), start, now in zip(
                    nominal, starts[row], poses(tasks[0].physics), strict=True
                )
            ]
        check(env, row, expected)
    displaced = env._current["state"][1, GLASS_Y] - nominal[0][0][1]
    assert (displaced > 0.04) == (hidden == "places")

    env.reset(TensorDict({"_reset": torch.tensor([[False], [True]])}, [2]))
    check(env, 1, nominal)
    env.close()


@every_kind
def test_the_simulation_is_untouched(hidden):
    envs = [NicoEnv(batch_size=[2], seed=4), HidingEnv(batch_size=[2], seed=4, hidden=hidden)]
    states = [env.reset(TensorDict({"task": torch.tensor([0, 2])}, [2])) for env in envs]
    assert not states[0]["pixels"].equal(states[1]["pixels"])
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        action = torch.rand(2, 4, generator=generator) * 2 - 1
        states = [
            env.step(state.set("action", action))["next"]
            for env, state in zip(envs, states, strict=True)
        ]
        true, hiding = (env.simulation_state() for env in envs)
        assert true["physics"].equal(hiding["physics"])
        assert states[0]["done"].equal(states[1]["done"])
    for env in envs:
        env.close()


def test_the_table_by_hand():
    success = {
        "seen": [[0.5, 1.0], [0.7, 1.0], [0.6, 1.0]],
        "hidden": [[0.0, 0.2], [0.0, 0.2], [0.0, 0.5]],
    }
    rows = [
        Row(condition, seed, task, 10, success[condition][seed][column])
        for condition in success
        for seed in range(3)
        for column, task in enumerate("ab")
    ]
    # The t value for three seeds is 4.303: .6 +- 4.303 x .1 / sqrt(3), .3 +- 4.303 x .1.
    assert looking.looking_table(rows) == [
        ["success, %", "seen", "hidden"],
        ["a", "60.0 [35, 85]", "0.0 [0, 0]"],
        ["b", "100.0 [100, 100]", "30.0 [0, 73]"],
        ["all", "80.0 [68, 92]", "15.0 [0, 37]"],
    ]
    one = [row for row in rows if row.seed == 1]
    assert looking.looking_table(one)[3] == ["all", "85.0", "10.0"]


def test_no_episodes_are_refused(scripted_run):
    with pytest.raises(ValueError, match="--episodes must be at least 1, got 0"):
        looking.measure_looking(scripted_run("turn", Turn, look), 0)
