"""Is this machine fit for it? ``python -m bgpo_trl.doctor`` looks, measures, and says what to do.

One line for each thing: ``ok``; ``note``, which costs something; or ``wrong``, which makes it
unusable and the exit status 1. Only the standard library is imported before a check asks for more,
so that whatever is broken is told like everything else.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np

    from suites.nico.rendering import FrameRenderer

CONSTRAINTS = Path(__file__).parents[1] / "constraints.txt"
"""Exact versions known to work together; only there in a checkout."""

FEW_FRAMES = 100.0
"""Frames a second below which rendering, not learning, is what a run waits for."""

# Three checkpoints (two kept, one being written) of 10 seeds, 20,000 episodes of 22 steps and 662
# bytes a transition take 9 GB; three of `--preset quick`, 3 seeds and 1,200 episodes, 0.2 GB.
_ROOM_FOR_ALL, _ROOM_FOR_SOME = 10e9, 0.5e9


@dataclass(frozen=True)
class Finding:
    """What came of one check.

    Attributes:
        level: ``"ok"``; ``"note"``, usable but; ``"wrong"``, unusable.
        what: What was looked at.
        told: What was found, and where it is amiss what to do; one line.
    """

    level: Literal["ok", "note", "wrong"]
    what: str
    told: str

    def __str__(self) -> str:
        return f"{self.level:<7}{self.what:<14}{self.told}"


Check = Callable[[], Iterator[Finding]]


# ---- versions


def judge_version(
    name: str, found: str | None, wanted: str, exact: str | None = None, *, optional: bool = False
) -> Finding:
    """Judge the version of a dependency.

    Args:
        name: Of its distribution.
        found: The installed version; None if it is not installed.
        wanted: The range that the code is written for, such as ``">=2.13,<3"``.
        exact: The version known to work, where that is known.
        optional: Whether most runs do without it.
    """
    from packaging.specifiers import SpecifierSet

    remedy = f"pip install '{name}{wanted}'" if exact is None else f"pip install {name}=={exact}"
    if found is None:
        if optional:
            return Finding("ok", name, f"not installed, optional: pip install 'bgpo_trl[{name}]'")
        return Finding("wrong", name, f"not installed: {remedy}")
    if not SpecifierSet(wanted).contains(found, prereleases=True):
        level = "note" if optional else "wrong"
        return Finding(level, name, f"{found} is outside {wanted}: {remedy}")
    # A build's own label, such as +cpu or +cu128, is not part of what was tried.
    if exact is not None and found.partition("+")[0] != exact:
        return Finding("note", name, f"{found}, known to work is {exact}; if in doubt: {remedy}")
    return Finding("ok", name, found)


def judge_python(found: str, wanted: str) -> Finding:
    """Judge the version of Python by the range of the package."""
    from packaging.specifiers import SpecifierSet

    if SpecifierSet(wanted).contains(found, prereleases=True):
        return Finding("ok", "python", f"{found}, {platform.system()} {platform.machine()}")
    return Finding("wrong", "python", f"{found} is outside {wanted}: make .venv with another one")


def read_constraints(path: Path) -> dict[str, str]:
    """Return the versions in a ``constraints.txt`` by name; none if there is no such file."""
    if not path.is_file():
        return {}
    lines = (line.partition("#")[0].strip() for line in path.read_text().splitlines())
    pairs = (line.partition("==") for line in lines if "==" in line)
    return {name.strip(): version.strip() for name, _, version in pairs}


def installed_version(name: str) -> str | None:
    """Return the version of a distribution, or None."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def check_versions(
    version: Callable[[str], str | None] = installed_version,
    constraints: Path = CONSTRAINTS,
) -> Iterator[Finding]:
    """Look at Python, at all dependencies, and at the extras that a run can use."""
    from packaging.requirements import Requirement

    try:
        distribution = importlib.metadata.distribution("bgpo_trl")
    except importlib.metadata.PackageNotFoundError:
        yield Finding("wrong", "bgpo_trl", "not installed: pip install -c constraints.txt -e .")
        return
    yield judge_python(platform.python_version(), distribution.metadata["Requires-Python"])
    exact = read_constraints(constraints)
    for line in distribution.requires or ():
        wanted = Requirement(line)
        optional = wanted.marker is not None
        if optional and wanted.name not in ("wandb", "ray"):
            continue  # for those who work on the package
        known = exact.get(wanted.name)
        found = version(wanted.name)
        yield judge_version(wanted.name, found, str(wanted.specifier), known, optional=optional)


# ---- what the robot sees


def judge_frames(still: np.ndarray, moved: np.ndarray) -> Finding:
    """Judge two frames, uint8 ``[32, 64, 3]``, between which the arm has moved."""
    import numpy as np

    colours = len(np.unique(still.reshape(-1, still.shape[-1]), axis=0))
    remedy = "try MUJOCO_GL=egl, then MUJOCO_GL=osmesa, and update the OpenGL driver"
    if colours < 20:  # a table, three objects and a hand, all shaded
        return Finding("wrong", "frame", f"blank, {colours} colours: {remedy}")
    changed = int((still != moved).any(-1).sum())
    if not changed:
        return Finding("wrong", "frame", f"stays the same when the arm moves: {remedy}")
    return Finding("ok", "frame", f"{colours} colours, {changed} pixels change as the arm moves")


def check_frame(path: Path | None = None) -> Iterator[Finding]:
    """Draw a frame before and after a movement; writes the first to a PNG where asked."""
    import numpy as np

    from suites import nico
    from suites.nico.rendering import FrameRenderer

    environment = nico.load("grasp_glass", seed=0, observation="state")
    physics = environment.physics
    try:
        renderer = FrameRenderer(physics.model.ptr)
    except RuntimeError as error:
        yield Finding("wrong", "OpenGL", _first_line(error))
        return
    environment.reset()
    still = renderer.render(physics.data.ptr)
    drawn_by = _driver(renderer)
    for _ in range(3):
        environment.step(np.array([1.0, 0.0, 0.0, 0.0]))
    moved = renderer.render(physics.data.ptr)
    renderer.close()
    yield Finding("ok", "OpenGL", f"{os.environ.get('MUJOCO_GL', 'default')}, {drawn_by}")
    yield judge_frames(still, moved)
    if path is not None:
        from PIL import Image

        Image.fromarray(still).resize((640, 320), Image.Resampling.NEAREST).save(path)
        yield Finding("ok", "frame", f"written to {path}")


def _driver(renderer: FrameRenderer) -> str:
    try:
        return renderer.driver()
    except Exception as error:  # It is only told; PyOpenGL raises errors of many kinds.
        return f"renderer unknown ({_first_line(error)})"


# ---- speed


def judge_frame_rate(one: float, every: float, cores: int) -> Finding:
    """Judge frames a second, of one thread and of one for each core."""
    told = f"{one:.0f} on one core, {every:.0f} on {cores}"
    if every < FEW_FRAMES:
        told += ": few; is the machine busy, or MUJOCO_GL another than egl?"
        return Finding("note", "frames/s", told)
    return Finding("ok", "frames/s", told)


def check_frame_rate(seconds: float = 0.5) -> Iterator[Finding]:
    """Measure ten simulations in one environment, with random actions."""
    import torch

    from bgpo_trl.envs import NicoEnv
    from bgpo_trl.machine import usable_cores

    def measure(threads: int) -> float:
        env = NicoEnv(batch_size=[10], seed=0, threads=threads)
        generator, state = torch.Generator().manual_seed(0), env.reset()

        def step() -> None:
            nonlocal state
            state["action"] = torch.rand(10, 4, generator=generator) * 2 - 1
            _, state = env.step_and_maybe_reset(state)

        rate = 10 * _rate(step, seconds)
        env.close()
        return rate

    cores = usable_cores()
    one = measure(1)
    yield judge_frame_rate(one, measure(cores) if cores > 1 else one, cores)


def check_update_rate(seconds: float = 0.5) -> Iterator[Finding]:
    """Measure what BGPO learns a second with five seeds, and loads the shipped weights for it."""
    import torch

    from bgpo_trl.algorithms.bgpo import BGPO
    from bgpo_trl.configs import BGPOConfig
    from bgpo_trl.encoders.pretrained import load_pretrained
    from bgpo_trl.transforms import TaskSchedule
    from bgpo_trl.world import World

    encoders, bank = load_pretrained()
    yield Finding("ok", "weights", f"encoders and {len(bank.task):,} embedded demonstrations")
    seeds = range(5)
    learner = BGPO(BGPOConfig(), seeds=seeds, bank=bank.seen(), encoders=encoders)
    world = World(learner, seeds=seeds, schedule=TaskSchedule(), bank=bank.seen())
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as in a run
    try:
        transition, _ = world.env.step_and_maybe_reset(learner.act(world.env.reset()))
        while not learner.update():  # not before it has seen enough
            learner.store(transition)
        rate = len(seeds) * _rate(learner.update, seconds)
    finally:
        torch.set_num_threads(threads)
        world.close()
    yield Finding("ok", "updates/s", f"{rate:.0f}, {len(seeds)} seeds together on one core")


def _rate(call: Callable[[], object], seconds: float) -> float:
    """Return how often a second something can be called."""
    call()
    start, calls = time.perf_counter(), 0
    while (spent := time.perf_counter() - start) < seconds:
        call()
        calls += 1
    return calls / spent


# ---- the machine


def check_device() -> Iterator[Finding]:
    """Look at cores, threads and GPUs."""
    import torch

    from bgpo_trl.machine import usable_cores

    told = f"{usable_cores()} to use of {os.cpu_count()}, PyTorch takes {torch.get_num_threads()}"
    yield Finding("ok", "cores", f"{told} by itself and 1 in a run")
    devices = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    yield judge_gpu(devices, driver=shutil.which("nvidia-smi") is not None)


def judge_gpu(devices: Sequence[str], *, driver: bool) -> Finding:
    """Judge the GPUs that PyTorch sees, and whether there is a driver for more."""
    if devices:
        return Finding("ok", "device", f"cuda: {', '.join(devices)}")
    if driver:
        remedy = "for --device cuda install PyTorch's build for the driver's CUDA (pytorch.org)"
        return Finding("note", "device", f"cpu, though there is an NVIDIA driver: {remedy}")
    return Finding("ok", "device", "cpu; no GPU is needed")


def judge_disk(free: float, folder: Path) -> Finding:
    """Judge the room (bytes) that is left where runs go."""
    told = f"{free / 1e9:.1f} GB left in {folder}"
    if free < _ROOM_FOR_SOME:
        return Finding("wrong", "disk", f"{told}: make room, or go elsewhere with --out")
    if free < _ROOM_FOR_ALL:
        return Finding("note", "disk", f"{told}: enough for all but a run of --preset paper")
    return Finding("ok", "disk", told)


def check_disk(folder: Path | None = None) -> Iterator[Finding]:
    """Look at the folder in which runs are kept, by default the current one."""
    folder = Path.cwd() if folder is None else folder
    if not os.access(folder, os.W_OK):
        yield Finding("wrong", "disk", f"{folder} cannot be written: go elsewhere, or use --out")
        return
    yield judge_disk(shutil.disk_usage(folder).free, folder)


# ---- all of it


def examine(checks: Mapping[str, Check]) -> Iterator[Finding]:
    """Run checks one after the other; one that breaks is a finding too."""
    for name, check in checks.items():
        try:
            yield from check()
        except Exception as error:
            told = f"{type(error).__name__}: {_first_line(error)}"
            yield Finding("wrong", name, f"cannot be checked ({told}): mend what is wrong above")


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; see ``--help``.

    Returns:
        The exit status: 1 if something makes it unusable, else 0.
    """
    # Not tyro, which may be what is broken.
    parser = argparse.ArgumentParser("python -m bgpo_trl.doctor", description=__doc__)
    parser.add_argument("--frame", type=Path, metavar="PNG", help="write what the robot sees")
    frame = parser.parse_args(arguments).frame
    checks: dict[str, Check] = {
        "versions": check_versions,
        "frame": lambda: check_frame(frame),
        "frames/s": check_frame_rate,
        "updates/s": check_update_rate,
        "device": check_device,
        "disk": check_disk,
    }
    levels = []
    for finding in examine(checks):
        sys.stdout.write(f"{finding}\n")
        sys.stdout.flush()
        levels.append(finding.level)
    counts = f"{levels.count('wrong')} wrong, {levels.count('note')} to note"
    sys.stdout.write(f"\n{counts}\n" if {"wrong", "note"} & {*levels} else "\nall is well\n")
    return int("wrong" in levels)


if __name__ == "__main__":
    sys.exit(main())
