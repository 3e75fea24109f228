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
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

# Three checkpoints (two kept, one being written) of 10 seeds and 20,000 episodes take 9 GB; three
# of `--preset quick` 0.2 GB.
_ROOM_FOR_ALL, _ROOM_FOR_SOME = 10e9, 0.5e9
_FEWEST_COLORS = 20  # of a table, three objects and a hand, all shaded
_FEW_FRAMES = 100.0  # frames a second below which rendering limits a run more than learning does


@dataclass(frozen=True)
class DoctorArguments:
    """Check this machine and installation, a line for each check.

    A line begins with ok; note, for usable with a limitation; or wrong, for unusable, with which
    the exit status is 1.
    """

    frame: Path | None = None
    """PNG file to write what the robot sees to."""
    scene: str = "nico"
    """Robot to check beside the machine, nico or one that the module of --import adds."""
    module: Annotated[str | None, tyro.conf.arg(name="import")] = None
    """Module that adds the robot; here or installed."""


class Limited(Exception):
    """Limitation, found by a check, of something that works all the same."""


def doctor(arguments: DoctorArguments) -> None:
    """Check this machine and installation, and print a line for each check."""
    name, frame = arguments.scene, arguments.frame
    checks: dict[str, Callable[[], str]] = {
        "versions": check_versions,
        "OpenGL": partial(check_frame, frame),
        "frames/s": partial(check_frame_rate, name),
        "threads": check_threads,
        "disk": partial(check_disk, Path.cwd()),
    }
    if name != "nico":
        del checks["OpenGL"]  # of NICO's renderer
        checks = {name: partial(check_scene, name, arguments.module, frame), **checks}
    wrong = False
    for subject, check in checks.items():
        try:
            level, message = "ok", check()
        except Limited as limitation:
            level, message = "note", str(limitation)
        except Exception as error:
            reason = next(iter(str(error).splitlines()), "")
            level, message, wrong = "wrong", f"{type(error).__name__}: {reason}", True
        sys.stdout.write(f"{level:<7}{subject:<10}{message}\n")
        sys.stdout.flush()
    if wrong:
        sys.exit(1)


def check_versions() -> str:
    """Check Python and the dependencies against the ranges of the package."""
    from packaging.requirements import Requirement
    from packaging.specifiers import SpecifierSet

    python = SpecifierSet(importlib.metadata.metadata("bgpo_trl")["Requires-Python"])
    if not python.contains(platform.python_version()):
        raise RuntimeError(f"Python is {platform.python_version()}, bgpo_trl needs {python}")
    required = map(Requirement, importlib.metadata.requires("bgpo_trl") or ())
    found, wrong = dict[str, str](), list[Requirement]()
    for wanted in required:
        if wanted.marker is None or wanted.marker.evaluate({"extra": ""}):
            try:
                found[wanted.name] = importlib.metadata.version(wanted.name)
            except importlib.metadata.PackageNotFoundError:
                found[wanted.name] = "missing"
                wrong.append(wanted)
                continue
            if not wanted.specifier.contains(found[wanted.name], prereleases=True):
                wrong.append(wanted)
    if wrong:
        reasons = ", ".join(f"{wanted.name} is {found[wanted.name]}" for wanted in wrong)
        remedy = " ".join(f"'{wanted.name}{wanted.specifier}'" for wanted in wrong)
        raise RuntimeError(f"{reasons}: pip install {remedy}")
    listed = ", ".join(f"{name} {version}" for name, version in found.items())
    return f"Python {platform.python_version()}, {listed}"


def check_frame(path: Path | None = None) -> str:
    """Draw the robot's view before and after a movement; optionally write the first to a PNG."""
    with suppress(Exception):  # reported by the checks that need it
        # Triton, which TensorDict imports beside torch for CUDA, crashes once Mesa has loaded LLVM.
        import tensordict  # noqa: F401

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
    driver = f"{os.environ.get('MUJOCO_GL', 'default')}, {renderer.driver()}"
    renderer.close()
    if path is not None:
        Image.fromarray(still).resize((640, 320), Image.Resampling.NEAREST).save(path)
    colors = len(np.unique(still.reshape(-1, still.shape[-1]), axis=0))
    changed = int((still != moved).any(-1).sum())
    seen = f"{driver}: {colors} colors, {changed} pixels change as the arm moves"
    if colors < _FEWEST_COLORS or not changed:
        raise RuntimeError(
            f"{seen}: try MUJOCO_GL=egl, then MUJOCO_GL=osmesa, and update the OpenGL driver"
        )
    return seen


def check_scene(name: str, module: str | None, path: Path | None = None) -> str:
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
    if path is not None:
        size = [8 * length for length in still.shape[1::-1]]
        Image.fromarray(still).resize(size, Image.Resampling.NEAREST).save(path)
    changed = int((still != moved).any(-1).sum())
    seen = f"{' x '.join(map(str, scene.frame_shape))}, {changed} pixels change by random actions"
    if not changed:
        raise RuntimeError(f"{seen}: are the camera and the actions' size as they should be?")
    return seen


def check_frame_rate(name: str = "nico", seconds: float = 0.5) -> str:
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
    if rate < _FEW_FRAMES:
        raise Limited(f"{rate:.0f}: few; is the machine busy, or MUJOCO_GL another than egl?")
    return f"{rate:.0f}"


def check_threads() -> str:
    """Report the cores and GPUs that a run can use."""
    import torch

    from bgpo_trl.machine import usable_cores

    gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    devices = f"cuda: {', '.join(gpus)}" if gpus else "no GPU, and none is needed"
    return f"{usable_cores()} of {os.cpu_count()} cores usable; {devices}"


def check_disk(folder: Path) -> str:
    """Check that the folder of the runs can be written and has room for them."""
    free = shutil.disk_usage(folder).free
    message = f"{free / 1e9:.1f} GB left in {folder}"
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder} cannot be written: go elsewhere, or use --out")
    if free < _ROOM_FOR_SOME:
        raise OSError(f"{message}: make room, or go elsewhere with --out")
    if free < _ROOM_FOR_ALL:
        raise Limited(f"{message}: enough for all but a run of --preset paper")
    return message
