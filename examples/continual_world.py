"""Continual World's ten tasks (CW10; Wolczyk et al., 2021) as a scene, from pixels.

Install Meta-World as `docs/extending.md` says, and name the module and the scene on a command line:
``--import examples.continual_world --scene cw10``. `benchmarks/continual_world.py` runs the
benchmark. The module draws the frames of all tasks: ``python -m examples.continual_world``.

An episode has 50 actions of four simulation steps each, hence 200 steps as in Continual World. It
succeeds if Meta-World reports success at any of these steps. Objects and goals are drawn anew for
each episode. Goals are green balls: Meta-World's own marks are smaller than a pixel of our frames.
Pucks are yellow and the wall is purple: Meta-World's are as dark as the table, and transparent.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bgpo_trl.scenes import SCENES, Outcome, SimulationEnv
from examples.meta_world import ACTION_REPEAT, METAWORLD, MetaWorld, World

CW10 = (
    "hammer",
    "push-wall",
    "faucet-close",
    "push-back",
    "stick-pull",
    "handle-press-side",
    "push",
    "shelf-place",
    "window-close",
    "peg-unplug-side",
)
# Tasks whose goal the objects do not show.
WITH_GOAL = ("push-wall", "push-back", "stick-pull", "push", "shelf-place")
WITH_PUCK = ("push-wall", "push-back", "push")
GOAL_RADIUS = 0.03  # m, a little more than a pixel
GREEN, YELLOW, PURPLE = (0, 1, 0, 1), (1, 1, 0, 1), (0.5, 0.2, 0.7, 1)


class VisibleWorld(World):
    """Meta-World's environment of a task, with goal, puck and wall that are seen in frames.

    The fingers and the stick are thinner than a pixel. Drawn at one point of each pixel, they
    would come and go as the arm moves.
    """

    samples = 4

    def __init__(self, task: str) -> None:
        super().__init__(task)
        if task in WITH_GOAL:
            goal = self.model.site("goal")
            goal.size[:], goal.rgba[:] = GOAL_RADIUS, GREEN
        if task in WITH_PUCK:
            self._paint("obj", YELLOW)
        if task == "push-wall":
            self._paint("wall", PURPLE)

    def _paint(self, body: str, color: Sequence[float]) -> None:
        """Color what is seen of a body; materials are dark, or nearly transparent."""
        geom = self.model.geom(int(self.model.body(body).geomadr[0]))
        geom.matid[:], geom.rgba[:] = -1, color


class ContinualWorld(MetaWorld):
    """One arm and the objects of the current task, with Continual World's measure of success."""

    make_world = VisibleWorld

    def step(self, action: NDArray[np.float64]) -> Outcome:
        """Perform an action: the hand's velocity along x, y and z, and closing of the gripper."""
        self._actions.append(action.tolist())
        with self.world.entered(self._state) as env:
            for _ in range(ACTION_REPEAT):
                self.observation, _, _, _, info = env.step(action)
                if info["success"]:
                    return Outcome(success=True)
        return Outcome(success=False)


def make_env(tasks: Sequence[str], **arguments: Any) -> SimulationEnv:
    """Return simulations of some tasks; arguments as for `SimulationEnv`."""
    return SimulationEnv(partial(ContinualWorld, {}), tasks, **arguments)


SCENES["cw10"] = replace(
    METAWORLD,
    name="cw10",
    version=METAWORLD.version.replace("1-", "2-", 1),  # 1: dark pucks, one point of a pixel
    tasks=CW10,
    default_tasks=CW10,
    make_env=make_env,
)


def draw_frames(path: Path, starts: int = 4) -> None:
    """Write one PNG: a row for each task, with its frame at some starts, enlarged four times."""
    from PIL import Image

    simulation, rows = ContinualWorld(), []
    for task in CW10:
        frames = []
        for start in range(starts):
            simulation.seed(start)
            simulation.reset(task)
            frames.append(simulation.frame())
        rows.append(np.hstack(frames))
    picture = np.vstack(rows).repeat(4, 0).repeat(4, 1)
    Image.fromarray(picture).save(path)


if __name__ == "__main__":
    draw_frames(Path(sys.argv[1] if len(sys.argv) > 1 else "cw10.png"))
