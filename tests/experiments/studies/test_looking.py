"""Tests with the places of the objects hidden from the policy."""

import json
import shutil
from itertools import product

import looking
import numpy as np
import pytest
import torch
from looking import HidingEnv, Row, plot_bars
from scipy.spatial.transform import Rotation
from shared import TrainedArguments, load_blocks
from tensordict import TensorDict

from bgpo_trl.runs.results import read_table
from suites import nico
from suites.nico.rendering import FrameRenderer
from tests.helpers import cells

GLASS_Y = 8  # of the state
VIEWS = ["seen", "places hidden", "objects hidden"]
CONDITIONS = [*VIEWS, "random actions"]


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


def turn(yaw):
    return torch.nn.functional.pad(yaw.unsqueeze(-1), (0, 3))


def look(state):
    """Turns to the glass, as far as it is displaced."""
    return turn((30 * (state[..., GLASS_Y] - nico.nominal_places()[0, 1])).clamp(-1, 1))


def remember(state):
    """Turns to the left, whatever it sees."""
    return turn(torch.ones_like(state[..., 0]))


@pytest.mark.parametrize("act", [look, remember])
def test_only_a_policy_that_uses_the_places_fails_without_them(scripted_run, act):
    """Starts are the same in all conditions, so one that acts blindly succeeds as often in all."""
    rows = looking.measure_looking(scripted_run("turn", Turn, act), 8)
    found = {
        row.condition: [r.success for r in rows if r.condition == row.condition] for row in rows
    }
    assert [*found] == CONDITIONS
    seen, *hidden = (found[view] for view in VIEWS)
    if act is look:
        assert min(seen) > 0.5
        assert hidden == [[0, 0]] * 2
    else:
        assert hidden == [seen] * 2
        assert 0 < seen[0] < 1 and seen[0] != seen[1]


def poses(physics):
    found = [physics.named.data.qpos[name] for name in nico.OBJECTS]
    return [(pose[:3].copy(), Rotation.from_quat(pose[[4, 5, 6, 3]])) for pose in found]


def check(env, row, expected):
    """Compare what is observed with a scene whose objects are in these poses."""
    shown = nico.Physics.from_xml_string(nico.scene_xml())
    shown.data.qpos[:] = env.simulations[row].environment.physics.data.qpos
    for name, (place, turned) in zip(nico.OBJECTS, expected, strict=True):
        shown.named.data.qpos[name] = [*place, *turned.as_quat()[[3, 0, 1, 2]]]
    shown.forward()
    frame = FrameRenderer(shown.model.ptr).render(shown.data.ptr)
    np.testing.assert_array_equal(env.frames()[row], frame)
    np.testing.assert_allclose(env._current["state"][row], shown.privileged_state(), atol=1e-6)


@pytest.mark.parametrize("hidden", ["places", "objects"])
def test_observations_show_objects_at_nominal_places(hidden):
    env = HidingEnv(batch_size=[2], seed=4, observation="both", hidden=hidden)
    state = env.reset()
    nominal = [(place, Rotation.identity()) for place in nico.nominal_places()]
    for row in range(2):
        check(env, row, nominal)
    starts = [poses(simulation.environment.physics) for simulation in env.simulations]

    # The second glass is moved, turned and knocked over: what is shown follows, or does not.
    physics = env.simulations[1].environment.physics
    toppled = Rotation.from_euler("xz", [90, 40], degrees=True).as_quat()
    pose = [*(starts[1][0][0] + [0.03, 0.05, -0.01]), *toppled[[3, 0, 1, 2]]]
    physics.named.data.qpos["glass"] = pose
    physics.forward()
    for _ in range(3):
        state.set("action", torch.tensor([[0.0, 0.0, 0.5, 0.0]] * 2))
        state = env.step(state)["next"]
    for row, simulation in enumerate(env.simulations):
        expected = nominal
        if hidden == "places":
            expected = [
                (place + now[0] - start[0], now[1] * start[1].inv())
                for (place, _), start, now in zip(
                    nominal, starts[row], poses(simulation.environment.physics), strict=True
                )
            ]
        check(env, row, expected)
    displaced = env._current["state"][1, GLASS_Y] - nominal[0][0][1]
    assert (displaced > 0.04) == (hidden == "places")

    env.reset(TensorDict({"_reset": torch.tensor([[False], [True]])}, [2]))
    check(env, 1, nominal)
    env.close()


def test_the_table_equals_that_by_hand():
    rows = [
        Row(condition, seed, task, 10, success)
        for condition, of_seeds in (
            ("seen", [(0.5, 1.0), (0.7, 1.0), (0.6, 1.0)]),
            ("hidden", [(0.0, 0.2), (0.0, 0.2), (0.0, 0.5)]),
        )
        for seed, of_tasks in enumerate(of_seeds)
        for task, success in zip("ab", of_tasks, strict=True)
    ]
    # The t value for three seeds is 4.303: .6 +- 4.303 x .1 / sqrt(3), .3 +- 4.303 x .1.
    assert looking.looking_table(rows) == [
        ["success, %", "seen", "hidden"],
        ["a", "60.0 [35, 85]", "0.0"],
        ["b", "100.0", "30.0 [0, 73]"],
        ["all", "80.0 [68, 92]", "15.0 [0, 37]"],
    ]
    one = [row for row in rows if row.seed == 1]
    assert looking.looking_table(one)[3] == ["all", "85.0", "10.0"]


def test_the_command_tests_every_seed_in_every_condition(run_of, tmp_path):
    out = tmp_path / "out"
    printed = looking.looking(TrainedArguments(run=run_of("bgpo"), episodes=1, out=out))
    rows = read_table(out / "looking.csv")
    found = [*rows[["condition", "seed", "task"]].itertuples(index=False, name=None)]
    assert found == [*product(CONDITIONS, (3, 8), nico.PAPER_TASKS)]
    assert set(rows["success"]) <= {0.0, 1.0}
    assert (out / "looking.png").exists()
    assert set(json.loads((out / "looking.json").read_text())) == {"commit", "command"}
    head, *lines = cells(printed)
    assert head == ["success, %", *CONDITIONS]
    assert [row[0] for row in lines] == [*nico.PAPER_TASKS, "all"]


def test_a_merged_run_is_tested_by_its_blocks(run_of):
    run = run_of("bgpo")
    assert [loaded.config.seeds for loaded in load_blocks(run)] == [(3, 8)]
    merged = run.parent / "merged"
    for block in ("seeds-3-8", "seeds-3-8-again"):
        shutil.copytree(run, merged / block)
    shutil.copy(run / "config.json", merged)
    assert [loaded.config.seeds for loaded in load_blocks(merged)] == [(3, 8), (3, 8)]


def test_bars_are_means_with_their_intervals():
    success = {"seen": [[0.5, 1.0], [0.7, 1.0], [0.6, 1.0]], "hidden": [[0.0, 0.2]]}
    (axes,) = plot_bars(success, ["grasp_glass", "push_green_to_white"]).axes
    heights = [bar.get_height() for bar in axes.patches]
    assert heights == pytest.approx([0.6, 1.0, 0.0, 0.2])
    centers = [bar.get_x() + bar.get_width() / 2 for bar in axes.patches]
    assert centers == pytest.approx([-0.2, 0.8, 0.2, 1.2])
    # The t value for three seeds is 4.303; equal scores have no interval, one seed no dots either.
    intervals, dots = axes.collections
    (found,) = [segment[:, 1] for segment in intervals.get_segments() if segment.size]
    half = 4.303 * 0.1 / np.sqrt(3)
    assert found == pytest.approx([0.6 - half, 0.6 + half], abs=1e-3)
    assert sorted(dots.get_offsets()[:, 1]) == pytest.approx([0.5, 0.6, 0.7, 1, 1, 1])
