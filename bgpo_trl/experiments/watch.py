"""Trained policies at work: a film beside demonstrations, and one shot from a film of others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from bgpo_trl.data.film import read_film
from bgpo_trl.data.recording import new_demonstrations
from bgpo_trl.experiments.arguments import OneShotArguments, WatchArguments
from bgpo_trl.figures.frames import plot_frame_strips, save_gif
from bgpo_trl.figures.style import save_figure
from bgpo_trl.files.writing import check_folder
from bgpo_trl.policy import Recognition, TrainedPolicy, load_run
from bgpo_trl.scenes import RobotEnv, Scene, Simulation, find_scene

_HEIGHT = 128  # (pixels) of each picture
_BORDER, _CAPTION, _GAP = 4, 18, 8
_COLORS = {None: "#999999", True: "#009E73", False: "#D55E00"}
_SPEED = 2  # times as fast as the robot
_USUAL_RATE = 5.0  # (Hz) of robots whose rate is unknown


@dataclass(frozen=True)
class Episode:
    """A demonstration and the policy's episode after it.

    Attributes:
        task: Name of the task.
        demonstration: Frames uint8 ``[T, H, W, 3]``.
        seen: Observed frames, uint8 ``[N, H, W, 3]``.
        view: An onlooker's view, uint8 ``[N, 128, W', 3]``; None if the scene has none.
        success: Whether the episode succeeded.
    """

    task: str
    demonstration: NDArray
    seen: NDArray
    view: NDArray | None
    success: bool

    @property
    def outcome(self) -> str:
        """Outcome and length of the episode, as a caption."""
        return f"{'success' if self.success else 'no success'} after {len(self.seen) - 1} steps"


def demonstrate(
    tasks: Sequence[str], seed: int, spread: float = 1.0, scene: Scene | str = "nico"
) -> dict[str, NDArray]:
    """Return a new demonstration of each task, uint8 ``[T, H, W, 3]``."""
    recorded = new_demonstrations(
        scene=scene, tasks=tasks, per_task=1, spread=spread, seed=seed, progress=False
    )
    pixels, length = recorded.get("pixels").numpy(), recorded.get("length").tolist()
    return {task: pixels[row, : length[row]] for row, task in enumerate(tasks)}


def play(policy: TrainedPolicy, task: str, demonstration: NDArray, seed: int) -> Episode:
    """Show the policy a demonstration, and return its episode from the start with that seed.

    Raises:
        ValueError: If the robot is no simulation.
    """
    policy.condition(demonstration, task=task)
    config, reads_joints = policy.config, policy.algorithm.joints is not None
    scene = find_scene(config.scene)
    env = scene.simulate([task], batch_size=1, seed=seed, spread=config.spread)
    if isinstance(env, RobotEnv):
        env.close()
        raise ValueError(
            f"the scene {scene.name!r} is a physical robot, which commands do not move: let it act "
            "in your own program (docs/deploy.md)"
        )
    # An environment of one's own has no `Simulation`.
    simulation = env.simulations[0] if hasattr(env, "simulations") else None
    state, seen, views = env.reset(), [env.frames()[0]], [_view(simulation)]
    for _ in range(config.algorithm.max_steps):
        joints = state["joints"][0].numpy() if reads_joints else None
        action = torch.from_numpy(policy.act(seen[-1], joints))
        state = env.step(state.set("action", action.unsqueeze(0)))["next"]
        seen.append(env.frames()[0])
        views.append(_view(simulation))
        if state["done"].any():
            break
    env.close()
    there = [view for view in views if view is not None]
    view, success = np.stack(there) if there else None, bool(state["success"].any())
    return Episode(task, demonstration, np.stack(seen), view, success)


def _view(simulation: Simulation | None) -> NDArray | None:
    """Return an onlooker's view, uint8 ``[128, W, 3]``; None if there is none."""
    if simulation is None:
        return None
    try:
        view = Image.fromarray(simulation.view())
    except NotImplementedError:
        return None
    width = round(view.width * _HEIGHT / view.height)
    return np.asarray(view.resize((width, _HEIGHT), Image.Resampling.LANCZOS))


def compose(episodes: Sequence[Episode], fps: float = 10.0) -> NDArray:
    """Return a frame per step with the episodes below one another, uint8 ``[T, H, W, 3]``.

    The frames continue to the end of the longest episode, and the last one is held for two seconds.
    """
    steps = max(max(len(e.demonstration), len(e.seen)) for e in episodes)
    pictures = [
        Image.fromarray(np.concatenate([_row(episode, step) for episode in episodes]))
        for step in range(steps)
    ]
    # A palette shared by all frames keeps static pixels identical: a quarter of the file size.
    sample = [np.asarray(picture) for picture in pictures[:: max(1, steps // 4)] + pictures[-1:]]
    palette = Image.fromarray(np.concatenate(sample)).quantize(128)
    frames = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    frames += frames[-1:] * round(2 * fps)
    return np.stack([np.asarray(frame.convert("RGB")) for frame in frames])


def _row(episode: Episode, step: int) -> NDArray:
    """Return the demonstration, what the policy sees and an onlooker's view, side by side."""
    now = min(step, len(episode.seen) - 1)
    ended = now == len(episode.seen) - 1
    color = _COLORS[episode.success if ended else None]
    progress = episode.outcome if ended else f"step {now}"
    shown = episode.demonstration[min(step, len(episode.demonstration) - 1)]
    panels = [_panel(shown, f"shown: {episode.task.replace('_', ' ')}", _COLORS[None])]
    if episode.view is None:
        panels.append(_panel(episode.seen[now], progress, color))
    else:
        panels.append(_panel(episode.seen[now], "the robot's view", color))
        panels.append(_panel(episode.view[now], progress, color))
    return np.concatenate(panels, axis=1)


def _panel(frame: NDArray, caption: str, color: str) -> NDArray:
    """Return a frame with a border of that color below its caption."""
    size = (round(frame.shape[1] * _HEIGHT / frame.shape[0]), _HEIGHT)
    image = Image.fromarray(frame).resize(size, Image.Resampling.NEAREST)
    image = ImageOps.expand(image, _BORDER, color)
    image = ImageOps.expand(image, (_GAP // 2, _CAPTION, _GAP // 2, _GAP), "white")
    fill = "black" if color == _COLORS[None] else color
    place = (_GAP // 2 + _BORDER, 0)
    ImageDraw.Draw(image).text(place, caption, fill=fill, font=ImageFont.load_default(13))
    return np.asarray(image)


def watch(arguments: WatchArguments) -> str:
    """Make the film that `WatchArguments` describes; return how the episodes ended."""
    run, out = arguments.run, arguments.out or arguments.run / "figures"
    policy = load_run(run, seed=arguments.run_seed)
    check_folder(out)
    config, seed = policy.config, arguments.scene_seed
    shown = demonstrate(policy.tasks, seed, config.spread, config.scene)
    episodes = [play(policy, task, frames, seed) for task, frames in shown.items()]
    fps = _SPEED * (find_scene(config.scene).rate or _USUAL_RATE)
    save_gif(compose(episodes, fps), out / "film.gif", fps=fps, scale=1)
    strips = {}
    for episode in episodes:
        strips[f"{episode.task}: the demonstration"] = episode.demonstration
        strips[f"{episode.task}: the robot's view, {episode.outcome}"] = episode.seen
    save_figure(plot_frame_strips(strips), out / "film.png")
    outcomes = [f"{episode.task}: {episode.outcome}" for episode in episodes]
    learned = f"seed {policy.seed} after {policy.episodes:,} of {config.episodes:,} episodes"
    return "\n".join([learned, *outcomes, f"pictures: {out}"])


def one_shot(arguments: OneShotArguments) -> str:
    """Show a policy a demonstration; return what it recognizes and, if asked for, achieves."""
    policy = load_run(arguments.run, seed=arguments.run_seed)
    seen, size = list[NDArray[np.uint8]](), ""
    for frame in read_film(arguments.demonstration):  # one at a time, as a film is large
        seen.append(policy.preprocess(frame, color="rgb", crop=arguments.crop))
        size = f"{frame.shape[0]} x {frame.shape[1]}"
    frames, lines = np.stack(seen), [f"{len(seen)} frames of {size}"]
    lines += _recognized(policy, policy.condition(frames, task=arguments.task))
    if arguments.task is None:
        return "\n".join([*lines, "--task NAME plays it in the simulation"])
    find_scene(policy.config.scene).check_tasks([arguments.task])
    episode = play(policy, arguments.task, frames, arguments.scene_seed)
    return "\n".join([*lines, f"{arguments.task}: {episode.outcome}"])


def _recognized(policy: TrainedPolicy, found: Recognition) -> list[str]:
    lines = []
    if found.node is not None:
        lines.append(f"behavior: node {found.node} of GWR-B, activity {found.activity:.2f}")
    if found.group is not None:
        novel = "within the group" if found.known else "unlike what the group was shown"
        lines.append(f"group {found.group}, novelty {found.group_novelty:.2f}: {novel}")
        lines.append(f"labels of the group, which the policy never reads: {_labels(policy, found)}")
    return lines or ["the algorithm has neither GWR-B nor groups: nothing is inferred"]


def _labels(policy: TrainedPolicy, found: Recognition) -> str:
    """Return the labels of a group's demonstrations in the run's bank, the commonest first."""
    groups = policy.algorithm.groups[policy.config.seeds.index(policy.seed)]
    own = groups.lookup(policy.bank.embedding).group == found.group
    counts = Counter(policy.bank.tasks[task] for task in policy.bank.task[own].tolist())
    shares = (f"{task} {n / counts.total():.0%}" for task, n in counts.most_common())
    return ", ".join(shares) or "none"
