"""Checks of this machine and installation: ``bgpo doctor``.

Third-party packages are imported in the checks that need them, so that a broken one is reported and
the other checks go on.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import tyro

# Three checkpoints (two kept, one being written) of 10 seeds and 20,000 episodes take 9 GB; three
# of `--preset quick` 0.2 GB.
_ROOM_FOR_ALL, _ROOM_FOR_SOME = 10e9, 0.5e9
_FEWEST_COLORS = 20  # of a table, three objects and a hand, all shaded
_FEW_FRAMES = 100.0  # frames a second below which rendering limits a run more than learning does
_OPENGL = "try MUJOCO_GL=egl, then MUJOCO_GL=osmesa, and update the OpenGL driver"


@dataclass(frozen=True)
class DoctorArguments:
    """Checks of this machine."""

    frame: Path | None = None
    """PNG file to write what the robot sees to."""
    scene: str = "nico"
    """Robot to check beside the machine, nico or one that the module of --import adds."""
    module: Annotated[str | None, tyro.conf.arg(name="import")] = None
    """Module that adds the robot; here or installed."""


class Finding(NamedTuple):
    """Result of one check: its level, its subject and a line, with a remedy if it is not ok."""

    level: Literal["ok", "note", "wrong"]
    subject: str
    message: str


def doctor(arguments: DoctorArguments) -> None:
    """Check this machine and installation, a line for each check.

    A line begins with ok; note, for usable with a limitation; or wrong, for unusable, with which
    the exit status is 1.
    """
    name, module, path = arguments.scene, arguments.module, arguments.frame
    foreign = name != "nico"
    checks: dict[str, Callable[[], Iterator[Finding]]] = {
        "versions": check_versions,
        "OpenGL": lambda: check_frame(None if foreign else path),
        **({name: lambda: check_scene(name, module, path)} if foreign else {}),
        "frames/s": lambda: check_frame_rate(name),
        "threads": check_threads,
        "disk": lambda: check_disk(Path.cwd()),
    }
    wrong = 0
    for finding in examine(checks):
        sys.stdout.write(f"{finding.level:<7}{finding.subject:<14}{finding.message}\n")
        sys.stdout.flush()
        wrong += finding.level == "wrong"
    if wrong:
        sys.exit(1)


def examine(checks: dict[str, Callable[[], Iterator[Finding]]]) -> Iterator[Finding]:
    """Run checks one after the other; a check that raises is a finding too."""
    for subject, check in checks.items():
        try:
            yield from check()
        except Exception as error:
            reason = next(iter(str(error).splitlines()), "")
            yield Finding("wrong", subject, f"{type(error).__name__}: {reason}")


def check_versions() -> Iterator[Finding]:
    """Check Python and the dependencies against the ranges of the package."""
    from packaging.requirements import Requirement
    from packaging.specifiers import SpecifierSet

    metadata = importlib.metadata.metadata("bgpo_trl")
    python = SpecifierSet(metadata["Requires-Python"])
    level = "ok" if python.contains(platform.python_version()) else "wrong"
    yield Finding(level, "python", f"{platform.python_version()}, needs {python}")
    for line in importlib.metadata.requires("bgpo_trl") or ():
        wanted = Requirement(line)
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": ""}):
            continue
        remedy = f"pip install '{wanted.name}{wanted.specifier}'"
        try:
            found = importlib.metadata.version(wanted.name)
        except importlib.metadata.PackageNotFoundError:
            yield Finding("wrong", wanted.name, f"not installed: {remedy}")
            continue
        if wanted.specifier.contains(found, prereleases=True):
            yield Finding("ok", wanted.name, found)
        else:
            yield Finding("wrong", wanted.name, f"{found}: {remedy}")


def check_frame(path: Path | None = None) -> Iterator[Finding]:
    """Draw the robot's view before and after a movement; optionally write the first to a PNG."""
    import numpy as np
    from PIL import Image

    from suites import nico
    from suites.nico.rendering import FrameRenderer

    environment = nico.load("grasp_glass", seed=0, observation="state")
    renderer = FrameRenderer(environment.physics.model.ptr)
    environment.reset()
    still = renderer.render(environment.physics.data.ptr)
    for _ in range(3):
        environment.step(np.array([1.0, 0.0, 0.0, 0.0]))
    moved = renderer.render(environment.physics.data.ptr)
    yield Finding("ok", "OpenGL", f"{os.environ.get('MUJOCO_GL', 'default')}, {renderer.driver()}")
    renderer.close()
    colors = len(np.unique(still.reshape(-1, still.shape[-1]), axis=0))
    changed = int((still != moved).any(-1).sum())
    seen = f"{colors} colors, {changed} pixels change as the arm moves"
    blank = colors < _FEWEST_COLORS or not changed
    yield Finding("wrong", "frame", f"{seen}: {_OPENGL}") if blank else Finding("ok", "frame", seen)
    if path is not None:
        Image.fromarray(still).resize((640, 320), Image.Resampling.NEAREST).save(path)


def check_scene(name: str, module: str | None, path: Path | None = None) -> Iterator[Finding]:
    """Draw a robot's view before and after random actions; optionally write the first to a PNG."""
    import torch
    from PIL import Image

    from bgpo_trl.plugins import import_plugin
    from bgpo_trl.scenes import find_scene

    import_plugin(module)
    scene, generator = find_scene(name), torch.Generator().manual_seed(0)
    env = scene.simulate(scene.default_tasks, batch_size=[1])
    state = env.reset()
    still = moved = state["pixels"][0].numpy()
    for _ in range(min(5, scene.max_steps)):
        state["action"] = torch.rand(1, scene.action_size, generator=generator) * 2 - 1
        _, state = env.step_and_maybe_reset(state)
        moved = state["pixels"][0].numpy()
    env.close()
    changed = int((still != moved).any(-1).sum())
    seen = f"{' x '.join(map(str, scene.frame_shape))}, {changed} pixels change by random actions"
    blind = ": are the camera and the actions' size as they should be?"
    yield Finding("ok" if changed else "wrong", name, seen + ("" if changed else blind))
    if path is not None:
        size = [8 * length for length in still.shape[1::-1]]
        Image.fromarray(still).resize(size, Image.Resampling.NEAREST).save(path)


def check_frame_rate(name: str = "nico", seconds: float = 0.5) -> Iterator[Finding]:
    """Measure ten simulations in one environment on all cores, with random actions."""
    import torch

    from bgpo_trl.scenes import find_scene

    scene, generator = find_scene(name), torch.Generator().manual_seed(0)
    env = scene.simulate(scene.default_tasks, batch_size=[10])
    state, steps, start = env.reset(), 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        state["action"] = torch.rand(10, scene.action_size, generator=generator) * 2 - 1
        _, state = env.step_and_maybe_reset(state)
        steps += 1
    rate = 10 * steps / (time.perf_counter() - start)
    env.close()
    few = rate < _FEW_FRAMES
    remedy = ": few; is the machine busy, or MUJOCO_GL another than egl?" if few else ""
    yield Finding("note" if few else "ok", "frames/s", f"{rate:.0f}{remedy}")


def check_threads() -> Iterator[Finding]:
    """Report the cores and GPUs that a run can use."""
    import torch

    from bgpo_trl.machine import usable_cores

    yield Finding("ok", "threads", f"{usable_cores()} of {os.cpu_count()} cores usable")
    gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    yield Finding("ok", "device", f"cuda: {', '.join(gpus)}" if gpus else "cpu; no GPU is needed")


def check_disk(folder: Path) -> Iterator[Finding]:
    """Check that the folder of the runs can be written and has room for them."""
    free = shutil.disk_usage(folder).free
    message = f"{free / 1e9:.1f} GB left in {folder}"
    if not os.access(folder, os.W_OK):
        yield Finding("wrong", "disk", f"{folder} cannot be written: go elsewhere, or use --out")
    elif free < _ROOM_FOR_SOME:
        yield Finding("wrong", "disk", f"{message}: make room, or go elsewhere with --out")
    elif free < _ROOM_FOR_ALL:
        yield Finding("note", "disk", f"{message}: enough for all but a run of --preset paper")
    else:
        yield Finding("ok", "disk", message)
