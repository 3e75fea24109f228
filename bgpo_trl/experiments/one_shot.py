"""Show a trained policy one film of a demonstration, and let it act in the simulation."""

from __future__ import annotations

import importlib
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bgpo_trl.experiments.arguments import OneShotArguments
from bgpo_trl.experiments.watch import play
from bgpo_trl.plugins import import_plugin
from bgpo_trl.policy import Recognition, load_run
from bgpo_trl.scenes import find_scene

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp")


def one_shot(arguments: OneShotArguments) -> str:
    """Show a policy a demonstration; return what it recognizes and, if asked for, achieves.

    Raises:
        ValueError: If the run or the demonstration cannot be read, or a task to play is unknown or
            has no simulation.
    """
    import_plugin(arguments.module)
    policy = load_run(arguments.run, seed=arguments.run_seed)
    film = read_film(arguments.demonstration)
    frames = policy.preprocess(film, color="rgb", crop=arguments.crop)
    lines = [f"{len(frames)} frames of {film.shape[1]} x {film.shape[2]}"]
    lines += _recognized(policy.condition(frames, task=arguments.task))
    if arguments.task is None:
        return "\n".join([*lines, "--task NAME plays it in the simulation"])
    find_scene(policy.config.scene).check_tasks([arguments.task])
    episode = play(policy, arguments.task, frames, arguments.scene_seed)
    return "\n".join([*lines, f"{arguments.task}: {episode.outcome}"])


def _recognized(found: Recognition) -> list[str]:
    lines = []
    if found.node is not None:
        lines.append(f"behavior: node {found.node} of GWR-B, activity {found.activity:.2f}")
    if found.group is not None:
        novel = "within the group" if found.known else "unlike what the group was shown"
        lines.append(f"group {found.group}, novelty {found.group_novelty:.2f}: {novel}")
    return lines or ["the algorithm has neither GWR-B nor groups: nothing is inferred"]


def read_film(path: Path) -> NDArray[np.uint8]:
    """Return the frames of a film, or of a folder of images in the order of their names.

    Returns:
        uint8 ``[T, H, W, 3]``, red first.

    Raises:
        ValueError: If there is no such film, PyAV is missing, or frames cannot be read, are of more
            than 8 bits a color or differ in size.
    """
    if path.is_dir():
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in _IMAGES)
        frames = [_image(image) for image in found]
    elif not path.exists():
        raise ValueError(f"there is no {path}: name a film, or a folder of images")
    else:
        frames = _decoded(path)
    if not frames:
        raise ValueError(f"{path} has no frames: name a film, or a folder of {', '.join(_IMAGES)}")
    if len({frame.shape for frame in frames}) > 1:
        raise ValueError(f"the frames in {path} differ in size: make them alike")
    return np.stack(frames)


def _image(path: Path) -> NDArray[np.uint8]:
    content = path.read_bytes()
    try:
        image = Image.open(io.BytesIO(content))
        pixels = np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError) as error:  # Pillow raises both for damaged PNG
        raise ValueError(f"{path} is no image that can be read: make it a PNG") from error
    sixteen = content.startswith(b"\x89PNG") and content[24] > 8  # Pillow drops half of them
    if sixteen or image.mode not in ("RGB", "P", "L") or image.has_transparency_data:
        raise ValueError(
            f"{path} is transparent or of more than 8 bits a color (mode {image.mode}): make it RGB"
        )
    return pixels


def _decoded(path: Path) -> list[NDArray[np.uint8]]:
    try:
        av = importlib.import_module("av")
    except ImportError:
        raise ValueError(
            f"{path} is a film: pip install av (PyAV) to decode it, or name a folder of its frames"
        ) from None
    try:
        with av.open(str(path)) as film:
            return [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    except (OSError, ValueError, IndexError) as error:
        raise ValueError(
            f"{path} is no film that can be decoded: name an mp4, or a folder of its frames"
        ) from error
