"""Frames per second: the hardware's limit, each layer of this package, and stock dm_control.

This package's layers step ten simulations per call. All contenders take random actions and reset
after 50 steps or a success.
"""

# MuJoCo's bindings come without stubs.
# pyright: reportAttributeAccessIssue=false

# ruff: noqa: I001 (the suite chooses an OpenGL backend, which MuJoCo reads when first imported)
from __future__ import annotations

from suites import nico

import contextlib
import multiprocessing
import os
from collections.abc import Callable
from multiprocessing.connection import Connection

import numpy as np
import torch
from bare_process import bare_process
from dm_control.suite.wrappers import pixels
from torchrl.envs import Compose, DMControlWrapper, EnvBase, TransformedEnv

from bgpo_trl.scenes.nico import NicoEnv
from bgpo_trl.modules.vae import VAE
from bgpo_trl.transforms import FrameEncoder
from suites.nico.base import Environment
from suites.nico.rendering import FRAME_CAMERA, FRAME_HEIGHT, FRAME_WIDTH

ROWS = 10
TASK = "grasp_glass"
EPISODE = 50
STOCK_FRAMES = 2


def contenders(threads: int, encoder: VAE) -> dict[str, tuple[Callable[[], object], int]]:
    """Return the contenders for `timing.interleave`.

    Args:
        threads: Threads of the bare limit and of the batched environment.
        encoder: Any frame encoder, trained or not.

    Returns:
        For each name, a call and the number of frames it makes.
    """
    task = nico.load(TASK, seed=0, time_limit=float("inf"))
    encode = Compose(FrameEncoder(encoder, del_keys=True))
    counts = sorted({1, threads})
    return {
        **{f"bare limit, {n} threads": (BareLoop(n).step, ROWS) for n in counts},
        "dm_control task, 1 thread": (_stepper(task), ROWS),
        **{f"TorchRL env, {n} threads": (_roller(_env(n)), ROWS) for n in counts},
        f"TorchRL env with encoder, {threads} threads": (
            _roller(TransformedEnv(_env(threads), encode)),
            ROWS,
        ),
        "stock": (Stock(default_visuals=True).step, STOCK_FRAMES),
        "stock, visual settings as here": (Stock(default_visuals=False).step, STOCK_FRAMES),
    }


def actions(seed: int = 0) -> Callable[[int], np.ndarray]:
    """Return a source of random actions: ``draw(n)`` gives ``[n, 4]`` in [-1, 1]."""
    rng = np.random.default_rng(seed)
    return lambda n: rng.uniform(-1, 1, (n, 4))


class BareLoop:
    """Lower bound: 20 physics steps, one rendering and one readout per frame, for ten simulations.

    The "threads" are processes, since some OpenGL libraries do not support concurrent drawing from
    threads. Joint targets are recorded from random actions, so that the arms move and hit objects
    as in the other contenders.

    Args:
        threads: Processes that share the simulations.
    """

    def __init__(self, threads: int) -> None:
        starts, targets = record()
        spawn = multiprocessing.get_context("spawn")
        view = (FRAME_CAMERA, FRAME_WIDTH, FRAME_HEIGHT)
        self._number = 0
        self._pipes = []
        for rows in np.array_split(np.arange(ROWS), threads):
            ours, theirs = spawn.Pipe()
            job = (theirs, nico.scene_xml(), view, starts[rows], targets[:, rows])
            spawn.Process(target=bare_process, args=job, daemon=True).start()
            self._pipes.append(ours)

    def step(self) -> None:
        """Make a frame of each simulation."""
        for pipe in self._pipes:
            pipe.send(self._number)
        for pipe in self._pipes:
            pipe.recv()
        self._number = (self._number + 1) % EPISODE


def record() -> tuple[np.ndarray, np.ndarray]:
    """Record an episode of random actions: starts ``[R, N]`` and joint targets ``[T, R, 6]``."""
    draw, starts, targets = actions(), [], []
    environments = [
        nico.load(TASK, seed=i, observation="state", time_limit=float("inf")) for i in range(ROWS)
    ]
    for environment in environments:
        environment.reset()
        starts.append(environment.physics.get_state())
    for _ in range(EPISODE):
        for environment, action in zip(environments, draw(ROWS), strict=True):
            environment.step(action)
            environment._reset_next_step = False  # Keeps the episode going after a success.
        targets.append([np.array(e.physics.data.ctrl) for e in environments])
    return np.array(starts), np.array(targets)


class Stock:
    """The same task as dm_control and TorchRL wrap it.

    It runs in a separate process, because this process disables the threads of Mesa's renderer.

    Args:
        default_visuals: Whether to use MuJoCo's default visual settings (shadows, multisampling)
            and Mesa's threads, or those of the suite.
    """

    def __init__(self, *, default_visuals: bool) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawn.Pipe()
        job = (theirs, default_visuals)
        spawn.Process(target=stock_process, args=job, daemon=True).start()

    def step(self) -> None:
        """Make ``STOCK_FRAMES`` frames of one simulation."""
        self._pipe.send(None)
        self._pipe.recv()


def stock_process(pipe: Connection, default_visuals: bool) -> None:
    """Make ``STOCK_FRAMES`` frames on each request."""
    xml = nico.scene_xml()
    if default_visuals:
        os.environ.pop("LP_NUM_THREADS", None)
        start, end = xml.index("<quality"), xml.index("/>", xml.index("<quality")) + 2
        xml = (xml[:start] + xml[end:]).replace('castshadow="false"', "")
    environment = nico.load(
        TASK, seed=0, observation="state", physics=nico.Physics.from_xml_string(xml)
    )
    size = {"height": FRAME_HEIGHT, "width": FRAME_WIDTH, "camera_id": FRAME_CAMERA}
    roll = _roller(DMControlWrapper(pixels.Wrapper(environment, render_kwargs=size)))
    with contextlib.suppress(EOFError):
        while True:
            pipe.recv()
            for _ in range(STOCK_FRAMES):
                roll()
            pipe.send(None)


def _env(threads: int) -> NicoEnv:
    return NicoEnv([TASK], batch_size=[ROWS], seed=0, threads=threads)


def _stepper(task: Environment) -> Callable[[], None]:
    draw, count = actions(), [0]
    task.reset()

    def step() -> None:
        for action in draw(ROWS):
            if task.step(action).last() or count[0] == EPISODE:
                task.reset()
                count[0] = 0
            count[0] += 1

    return step


def _roller(env: EnvBase) -> Callable[[], None]:
    draw, count, state = actions(), [0], [env.reset()]
    batch = env.batch_size

    def step() -> None:
        action = torch.from_numpy(draw(batch.numel())).to(env.action_spec.dtype)
        state[0].set("action", action.view(*batch, 4))
        _, state[0] = env.step_and_maybe_reset(state[0])
        count[0] += 1
        if count[0] == EPISODE:
            state[0], count[0] = env.reset(), 0

    return step
