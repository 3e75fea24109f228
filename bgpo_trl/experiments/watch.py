"""Film of a run's trained policies beside the demonstrations that they were shown."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.experiments.arguments import ImportArguments
from bgpo_trl.figures.frames import plot_frame_strips, save_gif
from bgpo_trl.figures.of_run import draw_growth
from bgpo_trl.figures.style import save_figure
from bgpo_trl.plugins import import_plugin
from bgpo_trl.policy import TrainedPolicy, load_run
from suites import nico
from suites.nico.rendering import FrameRenderer

__all__ = ["Episode", "WatchArguments", "compose", "demonstrate", "play", "watch"]

_ROOM = (180, 70, 600, 350)  # (pixels) crop of the 640x480 room view to NICO and the table
_SIZES = ((256, 128), (256, 128), (192, 128))
_BORDER, _CAPTION, _GAP = 4, 18, 8
_COLORS = {None: "#999999", True: "#009E73", False: "#D55E00"}
_FPS = 10  # twice as fast as NICO


@dataclass(frozen=True)
class WatchArguments(ImportArguments):
    """A film of a run."""

    run: tyro.conf.Positional[Path]
    """Run directory."""
    run_seed: int | None = None
    """Seed of the run whose policy acts; the first by default."""
    scene_seed: int = 1
    """Seed of demonstrations and starts; the pretrained encoders were trained on seed 0."""
    out: Path | None = None
    """Folder for the pictures; figures/ of the run by default."""


@dataclass(frozen=True)
class Episode:
    """A demonstration and the policy's episode after it.

    Attributes:
        task: Name of the task.
        demonstration: Frames uint8 ``[T, 32, 64, 3]``.
        seen: Observed frames, uint8 ``[N, 32, 64, 3]``.
        room: View of the room, uint8 ``[N, 128, 192, 3]``.
        success: Whether the episode succeeded.
    """

    task: str
    demonstration: NDArray
    seen: NDArray
    room: NDArray
    success: bool

    @property
    def outcome(self) -> str:
        """Outcome and length of the episode, as a caption."""
        return f"{'success' if self.success else 'no success'} after {len(self.seen) - 1} steps"


def demonstrate(tasks: Sequence[str], seed: int, spread: float = 1.0) -> dict[str, NDArray]:
    """Return a new demonstration of each task, uint8 ``[T, 32, 64, 3]``."""
    with tempfile.TemporaryDirectory() as folder:
        recorded = record_demonstrations(
            folder,
            tasks=tasks,
            per_task=1,
            held_out_per_task=0,
            spread=spread,
            seed=seed,
            progress=False,
        ).to_tensordict()
    pixels, length = recorded.get("pixels").numpy(), recorded.get("length").tolist()
    return {task: pixels[row, : length[row]] for row, task in enumerate(tasks)}


def play(policy: TrainedPolicy, task: str, demonstration: NDArray, seed: int) -> Episode:
    """Show the policy a demonstration, and return its episode from the start with that seed."""
    policy.condition(demonstration, task=task)
    env = nico.load(task, seed=seed, spread=policy.config.spread)
    renderer = FrameRenderer(env.physics.model.ptr, "room", height=480, width=640)

    def look() -> NDArray:
        room = Image.fromarray(renderer.render(env.physics.data.ptr)).crop(_ROOM)
        return np.asarray(room.resize(_SIZES[2], Image.Resampling.LANCZOS))

    timestep = env.reset()
    seen, room = [timestep.observation["pixels"]], [look()]
    while not timestep.last() and len(seen) <= policy.config.algorithm.max_steps:
        timestep = env.step(policy.act(seen[-1]))
        seen.append(timestep.observation["pixels"])
        room.append(look())
    renderer.close()
    return Episode(task, demonstration, np.stack(seen), np.stack(room), bool(timestep.reward))


def compose(episodes: Sequence[Episode]) -> NDArray:
    """Return a frame per step with the episodes below one another, uint8 ``[T, H, W, 3]``.

    The frames continue to the end of the longest episode, and the last one is held for two seconds.
    """
    steps = max(max(len(e.demonstration), len(e.seen)) for e in episodes)
    height = _CAPTION + _SIZES[0][1] + 2 * _BORDER + _GAP
    width = sum(width + 2 * _BORDER for width, _ in _SIZES) + 4 * _GAP
    pictures = []
    for step in range(steps):
        picture = Image.new("RGB", (width, height * len(episodes) + _GAP), "white")
        for row, episode in enumerate(episodes):
            _draw(picture, episode, step, row * height + _GAP // 2)
        pictures.append(picture)
    # A palette shared by all frames keeps static pixels identical: a quarter of the file size.
    sample = [np.asarray(picture) for picture in pictures[:: max(1, steps // 4)] + pictures[-1:]]
    palette = Image.fromarray(np.concatenate(sample)).quantize(128)
    frames = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    frames += frames[-1:] * 2 * _FPS
    return np.stack([np.asarray(frame.convert("RGB")) for frame in frames])


def _draw(picture: Image.Image, episode: Episode, step: int, top: int) -> None:
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    now = min(step, len(episode.seen) - 1)
    outcome = episode.success if now == len(episode.seen) - 1 else None
    shown = episode.demonstration[min(step, len(episode.demonstration) - 1)]
    color = _COLORS[outcome]
    panels = (
        (shown, f"shown: {episode.task.replace('_', ' ')}", _COLORS[None]),
        (episode.seen[now], "NICO's view", color),
        (episode.room[now], f"step {now}" if outcome is None else episode.outcome, color),
    )
    left = _GAP
    for (frame, caption, border), size in zip(panels, _SIZES, strict=True):
        image = Image.fromarray(frame).resize(size, Image.Resampling.NEAREST)
        picture.paste(ImageOps.expand(image, _BORDER, border), (left, top + _CAPTION))
        fill = "black" if border == _COLORS[None] else border
        draw.text((left + _BORDER, top), caption, fill=fill, font=font)
        left += size[0] + 2 * _BORDER + _GAP


def watch(arguments: WatchArguments) -> str:
    """Film the trained policies of a run beside new demonstrations that they are shown.

    Writes nico.gif, and its frames as a strip nico.png, into the run's figures/: for each task the
    demonstration, the policy's observations and a view of the room, framed green on success and red
    on timeout. NICO starts from the same scene in every task, so only the demonstration makes the
    difference. If the run saved graphs, also writes gwr_growth.png, the growth of GWR-B.

    Raises:
        ValueError: If the directory holds no run that can be loaded, or the run has no such seed.
    """
    run, out = arguments.run, arguments.out or arguments.run / "figures"
    import_plugin(arguments.module)
    policy = load_run(run, seed=arguments.run_seed)
    shown = demonstrate(policy.tasks, arguments.scene_seed, policy.config.spread)
    episodes = [play(policy, task, frames, arguments.scene_seed) for task, frames in shown.items()]
    out.mkdir(parents=True, exist_ok=True)
    save_gif(compose(episodes), out / "nico.gif", fps=_FPS, scale=1)
    strips = {}
    for episode in episodes:
        strips[f"{episode.task}: the demonstration"] = episode.demonstration
        strips[f"{episode.task}: NICO's view, {episode.outcome}"] = episode.seen
    save_figure(plot_frame_strips(strips), out / "nico.png")
    draw_growth(run, policy.config, policy.bank, out)
    outcomes = [f"{episode.task}: {episode.outcome}" for episode in episodes]
    learned = f"seed {policy.seed} after {policy.episodes:,} training episodes"
    return "\n".join([learned, *outcomes, f"pictures: {out}"])
