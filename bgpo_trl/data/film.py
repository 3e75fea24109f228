"""Frames from images and films of others: read exactly, or refused."""

from __future__ import annotations

import importlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp")


class UnreadableError(ValueError):
    """A file cannot be taken as it is; the message says why."""


def decode_image(content: bytes) -> NDArray[np.uint8]:
    """Return an image of 8 bits a color as ``[H, W, 3]``, red first.

    Raises:
        UnreadableError: If it is transparent or of more than 8 bits.
        OSError, SyntaxError: If it is damaged, from Pillow.
    """
    image = Image.open(io.BytesIO(content))
    sixteen = content.startswith(b"\x89PNG") and content[24] > 8  # Pillow drops half of them
    if sixteen or image.mode not in ("1", "L", "P", "RGB", "LA", "RGBA"):
        raise UnreadableError(
            f"its images are of mode {image.mode}, of more than 8 bits: make them uint8 by a scale "
            "of yours, or choose another camera"
        )
    if image.has_transparency_data and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
        raise UnreadableError("its images are transparent: put them on a background of yours")
    return np.asarray(image.convert("RGB"))


def check_depth(stream: Any) -> None:
    """Check that a video stream of PyAV has 8 bits a color.

    Raises:
        UnreadableError: If it has more, as that of a depth map.
    """
    name = stream.format.name
    if name.startswith("gray") and name != "gray":
        raise UnreadableError(f"its frames are {name}, of more than 8 bits, as of a depth map")


def read_film(path: Path) -> NDArray[np.uint8]:
    """Return the frames of a film, or of a folder of images in the order of their names.

    Returns:
        uint8 ``[T, H, W, 3]``, red first.

    Raises:
        UnreadableError: If there is no such film, PyAV is missing, or frames cannot be read, are
            transparent, of more than 8 bits a color or of several sizes.
    """
    if not path.exists():
        raise UnreadableError(f"there is no {path}: name a film, or a folder of images")
    frames, file = list[NDArray[np.uint8]](), path
    try:
        if path.is_dir():
            for file in sorted(p for p in path.iterdir() if p.suffix.lower() in _IMAGES):
                frames.append(decode_image(file.read_bytes()))
        else:
            with importlib.import_module("av").open(str(path)) as film:
                check_depth(film.streams.video[0])
                frames += [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    except UnreadableError as error:
        raise UnreadableError(f"{file}: {error}") from None
    except ImportError:
        raise UnreadableError(
            f"{path} is a film: pip install av (PyAV) to decode it, or name a folder of its frames"
        ) from None
    except (OSError, SyntaxError, ValueError, IndexError) as error:  # of Pillow and PyAV
        raise UnreadableError(
            f"{file} cannot be decoded: name a film, or a folder of its frames as PNG"
        ) from error
    if not frames:
        raise UnreadableError(f"{path} has no frames: name a film, or a folder of images")
    if len({frame.shape for frame in frames}) > 1:
        raise UnreadableError(f"the frames in {path} differ in size: make them alike")
    return np.stack(frames)
