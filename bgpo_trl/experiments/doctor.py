"""Checks of this machine and installation: ``bgpo doctor``."""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path

from bgpo_trl.experiments.arguments import DoctorArguments

# Checkpoints of `--preset quick` take 0.2 GB; of 10 seeds and 20,000 episodes 9 GB.
_ROOM = 0.5e9
# Below, a run of --preset quick takes an hour for its frames alone.
_SLOW = 30


def doctor(arguments: DoctorArguments) -> None:
    """Check this machine and installation, and print a line for each check."""
    checks: dict[str, Callable[[], str]] = {
        "versions": check_versions,
        arguments.scene: lambda: check_robot(arguments),
        "disk": check_disk,
    }
    wrong = False
    for subject, check in checks.items():
        try:
            level, message = "ok", check()
        except UserWarning as doubt:
            level, message = "look", str(doubt)
        except Exception as error:  # A broken package is reported, and the other checks go on.
            reason = next(iter(str(error).splitlines()), "")
            level, message, wrong = "wrong", f"{type(error).__name__}: {reason}", True
        sys.stdout.write(f"{level:<7}{subject:<10}{message}\n")
        sys.stdout.flush()
    if wrong:
        sys.exit(1)


def check_versions() -> str:
    """Check the dependencies against the ranges of the package."""
    from packaging.requirements import Requirement

    found, wrong = [f"Python {sys.version.split()[0]}"], list[str]()
    for wanted in map(Requirement, importlib.metadata.requires("bgpo_trl") or ()):
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(wanted.name)
        except importlib.metadata.PackageNotFoundError:
            version = "missing"
        found.append(f"{wanted.name} {version}")
        if version == "missing" or not wanted.specifier.contains(version, prereleases=True):
            wrong.append(f"'{wanted.name}{wanted.specifier}'")
    if wrong:
        raise RuntimeError(f"{', '.join(found)}: pip install {' '.join(wrong)}")
    return ", ".join(found)


def check_robot(arguments: DoctorArguments) -> str:
    """Play random actions in ten simulations and count frames a second; then `check_scene`.

    Raises:
        UserWarning: What is doubtful.
    """
    import torch
    from PIL import Image

    from bgpo_trl.scenes import RobotEnv, find_scene
    from bgpo_trl.scenes.check import check_scene

    scene = find_scene(arguments.scene)
    if scene.make_env is None:
        return "it has no simulation to try"
    one = scene.simulate(scene.default_tasks, batch_size=[1])
    one.close()
    if isinstance(one, RobotEnv):
        return "a physical robot, which is not moved to try it"
    env = scene.simulate(scene.default_tasks, batch_size=[10], seed=0)
    torch.manual_seed(0)
    start = time.perf_counter()
    episode = env.rollout(min(5, scene.max_steps))[0]
    rate = 10 * len(episode) / (time.perf_counter() - start)
    env.close()
    still, moved = episode["pixels"][0].numpy(), episode["next", "pixels"][-1].numpy()
    if arguments.frame is not None:
        size = [8 * length for length in still.shape[1::-1]]
        Image.fromarray(still).resize(size, Image.Resampling.NEAREST).save(arguments.frame)
    changed = int((still != moved).any(-1).sum())
    seen = (
        f"{' x '.join(map(str, scene.frame_shape))}, {changed} pixels change by random actions, "
        f"{rate:.0f} frames a second, MUJOCO_GL={os.environ.get('MUJOCO_GL', '')}"
    )
    if not changed:
        raise RuntimeError(
            f"{seen}: try MUJOCO_GL=egl or osmesa; of an own scene, check camera and actions"
        )
    if rate < _SLOW:
        seen += (
            "; this is slow, unless other programs used the cores: without a GPU, shadows and "
            "antialiasing cost most, switch them off in an own scene (docs/extending.md, Your "
            "robot)"
        )
    if doubts := check_scene(scene):
        raise UserWarning("; ".join([seen, *doubts]))
    return seen


def check_disk() -> str:
    """Check that this folder can be written and has room for runs."""
    folder = Path.cwd()
    free = shutil.disk_usage(folder).free
    message = f"{free / 1e9:.1f} GB left in {folder}"
    if not os.access(folder, os.W_OK) or free < _ROOM:
        raise OSError(f"{message}: make room, or go to a folder that can be written")
    return f"{message}, of which a run of --preset paper takes 9"
