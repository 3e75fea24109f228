"""Show an episode of NICO: ``python -m suites.nico.explore --task push_green_to_glass``.

With a screen, MuJoCo's viewer opens, in which the mouse can move objects. Without one, or with
``--out``, an episode is written as a strip of frames (``.png``) or an animation (``.gif``): the
robot's observation above a view of the room.
"""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from dm_env import TimeStep
from PIL import Image, ImageDraw

from suites import nico
from suites.nico.base import CONTROL_TIMESTEP, Environment
from suites.nico.demonstrator import Demonstrator
from suites.nico.rendering import FrameRenderer

Policy = Callable[[TimeStep], np.ndarray]

_PANEL_WIDTH = 320  # (pixels)
_STRIP_LENGTH = 6  # panels
_POLICY = tyro.conf.create_mutex_group(required=False)


@dataclass(frozen=True)
class Arguments:
    """Show an episode of NICO, in a window or, without a screen, as a picture."""

    task: str = nico.ALL_TASKS[0]
    """Name of the task, such as grasp_glass or lift_green; `suites/nico/README.md` lists all."""
    out: Path | None = None
    """File to write, .png or .gif; by default TASK.png if there is no screen."""
    demonstrate: Annotated[bool, _POLICY, tyro.conf.FlagCreatePairsOff] = False
    """Act with the demonstrator (the default)."""
    random: Annotated[bool, _POLICY, tyro.conf.FlagCreatePairsOff] = False
    """Act at random."""
    seed: int = 0
    """Seed of the start and of the actions."""


class _ShownPhysics(nico.Physics):
    """Simulation that runs in real time and shows each physics step."""

    show: Callable[[], None] | None = None

    def step(self, nstep: int = 1) -> None:
        for _ in range(nstep):
            start = time.monotonic()
            super().step()
            if self.show is not None:
                self.show()
                time.sleep(max(0.0, start + self.timestep() - time.monotonic()))


def has_screen() -> bool:
    """Return whether a window can be opened."""
    if platform.system() != "Linux":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def make_policy(env: Environment, *, random: bool, seed: int) -> Policy:
    """Return a policy that maps a time step to an action ``[4]``: random, or the demonstrator."""
    generator = np.random.default_rng(seed)
    if random:
        return lambda _: generator.uniform(-1.0, 1.0, 4)
    demonstrator = Demonstrator(env, seed=generator)

    def demonstrate(timestep: TimeStep) -> np.ndarray:
        if timestep.first():
            demonstrator.reset()
        return demonstrator(timestep)

    return demonstrate


def picture_episode(task: str, *, random: bool = False, seed: int = 0) -> list[Image.Image]:
    """Run an episode and return a captioned picture of each step.

    Args:
        task: Name of the task.
        random: Whether to act at random instead of demonstrating.
        seed: Seed of the start and of the actions.

    Returns:
        Pictures 320 pixels wide: the enlarged 64x32 observation above a view of the room.

    Raises:
        ValueError: If there is no such task.
        RuntimeError: If there is no OpenGL to render with.
    """
    env = nico.load(task, seed=seed)
    room = FrameRenderer(env.physics.model.ptr, "room", height=480, width=640)
    policy = make_policy(env, random=random, seed=seed)
    timestep = env.reset()
    pictures = []
    while True:
        caption = f"{task}, step {len(pictures)}{', success' if timestep.reward else ''}"
        room_frame = room.render(env.physics.data.ptr)
        pictures.append(_picture(timestep.observation["pixels"], room_frame, caption))
        if timestep.last():
            return pictures
        timestep = env.step(policy(timestep))


def _picture(seen: np.ndarray, room: np.ndarray, caption: str) -> Image.Image:
    picture = Image.new("RGB", (_PANEL_WIDTH, _PANEL_WIDTH // 2 + _PANEL_WIDTH * 3 // 4))
    enlarged = Image.fromarray(seen).resize(
        (_PANEL_WIDTH, _PANEL_WIDTH // 2), Image.Resampling.NEAREST
    )
    picture.paste(enlarged, (0, 0))
    # Rendered larger and then reduced, since the scene has no multisampling.
    reduced = Image.fromarray(room).resize((_PANEL_WIDTH, _PANEL_WIDTH * 3 // 4))
    picture.paste(reduced, (0, _PANEL_WIDTH // 2))
    ImageDraw.Draw(picture).text((6, picture.height - 16), caption, fill="white")
    return picture


def write_pictures(path: Path, pictures: Sequence[Image.Image]) -> None:
    """Write pictures of an episode as a strip of six (``.png``) or all of them (``.gif``).

    Raises:
        ValueError: If the file has another suffix, or its folder does not exist.
        OSError: If it cannot be written.
    """
    _check_path(path)
    if path.suffix == ".gif":
        first, *others = pictures
        milliseconds = round(1000 * CONTROL_TIMESTEP)
        first.save(path, save_all=True, append_images=others, duration=milliseconds, loop=0)
    else:
        chosen = np.linspace(0, len(pictures) - 1, _STRIP_LENGTH).round().astype(int)
        strip = Image.new("RGB", (_PANEL_WIDTH * _STRIP_LENGTH, pictures[0].height))
        for column, index in enumerate(chosen):
            strip.paste(pictures[index], (column * _PANEL_WIDTH, 0))
        strip.save(path)


def _check_path(path: Path) -> None:
    if path.suffix not in (".png", ".gif"):
        raise ValueError(f"cannot write {path}: give a name that ends in .png or .gif")
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: there is no folder {path.parent}, make it first")


def view(task: str, *, random: bool = False, seed: int = 0) -> None:
    """Run episodes in MuJoCo's viewer until its window is closed.

    Raises:
        ValueError: If there is no such task.
    """
    import mujoco.viewer  # fails without a screen

    physics = _ShownPhysics.from_xml_string(nico.scene_xml())
    env = nico.load(task, seed=seed, observation="state", physics=physics)
    policy = make_policy(env, random=random, seed=seed)
    timestep = env.reset()
    with mujoco.viewer.launch_passive(physics.model.ptr, physics.data.ptr) as viewer:
        physics.show = viewer.sync
        while viewer.is_running():
            timestep = env.reset() if timestep.last() else env.step(policy(timestep))


def main(arguments: Arguments) -> None:
    """Run the command line."""
    how = {"random": arguments.random, "seed": arguments.seed}
    if arguments.out is None and has_screen():
        view(arguments.task, **how)
        return
    out = arguments.out or Path(f"{arguments.task}.png")
    _check_path(out)
    write_pictures(out, picture_episode(arguments.task, **how))
    sys.stdout.write(f"wrote {out}\n")


if __name__ == "__main__":
    try:
        main(tyro.cli(Arguments, description=Arguments.__doc__))
    except (ValueError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
