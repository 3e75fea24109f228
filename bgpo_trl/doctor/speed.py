"""Checks of speed: frames and updates a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from bgpo_trl.doctor.finding import Finding

FEW_FRAMES = 100.0
"""Frames a second below which rendering limits a run more than learning does."""


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
    """Load the shipped weights and measure the updates a second of BGPO with five seeds."""
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
        while not learner.update():  # empty during warm-up
            learner.store(transition)
        rate = len(seeds) * _rate(learner.update, seconds)
    finally:
        torch.set_num_threads(threads)
        world.close()
    yield Finding("ok", "updates/s", f"{rate:.0f}, {len(seeds)} seeds together on one core")


def _rate(call: Callable[[], object], seconds: float) -> float:
    """Return the number of calls a second."""
    call()
    start, calls = time.perf_counter(), 0
    while (spent := time.perf_counter() - start) < seconds:
        call()
        calls += 1
    return calls / spent
