"""Frames from images and films of others: read exactly, or refused."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from bgpo_trl.errors import UnreadableError, check_fetched

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp")
# Of Pillow and PyAV.
_UNDECODABLE = (OSError, SyntaxError, ValueError, IndexError, Image.DecompressionBombError)


def decode_image(content: bytes) -> NDArray[np.uint8]:
    """Return an image of 8 bits a color as ``[H, W, 3]``, red first, upright as its camera says.

    Raises:
        UnreadableError: If it is transparent or of more than 8 bits.
        OSError, SyntaxError: If it is damaged, from Pillow.
    """
    image = ImageOps.exif_transpose(Image.open(io.BytesIO(content)))
    sixteen = content.startswith(b"\x89PNG") and content[24] > 8  # Pillow drops half of them
    if sixteen or image.mode not in ("1", "L", "P", "RGB", "LA", "RGBA"):
        what = "not of red, green and blue" if image.mode == "CMYK" else "of more than 8 bits"
        raise UnreadableError(
            f"its images are of mode {image.mode}, {what}: make them uint8 RGB by a scale of "
            "yours, or choose another camera"
        )
    if image.has_transparency_data:
        check_opaque(np.asarray(image.convert("RGBA")))
    return np.asarray(image.convert("RGB"))


def check_depth(stream: Any) -> None:
    """Check that a video stream of PyAV has 8 bits a color.

    Raises:
        UnreadableError: If it has more, as that of a depth map or of HDR.
    """
    if any(component.bits > 8 for component in stream.format.components):
        raise UnreadableError(
            f"its frames are {stream.format.name}, of more than 8 bits, as of a depth map or of "
            "HDR: convert it to 8 bits"
        )


def undamaged(frames: Iterable[Any]) -> Iterator[Any]:
    """Yield frames of PyAV, all that it decodes, since damage spreads to later ones.

    Decoders of H.264 and MPEG-4 tell which frames are damaged; those of VP9 and HEVC do not.

    Raises:
        UnreadableError: If a frame is damaged.
    """
    for frame in frames:
        if frame.is_corrupt:
            raise UnreadableError("it is damaged, and its frames would be guessed: get it again")
        yield frame


def decode_frame(frame: Any) -> NDArray[np.uint8]:
    """Return a frame of PyAV as ``[H, W, 3]``, red first, upright as its camera says.

    Raises:
        UnreadableError: If it is transparent, or turned by no whole number of quarters.
    """
    if any(component.is_alpha for component in frame.format.components):
        check_opaque(frame.to_ndarray(format="rgba"))
    pixels = frame.to_ndarray(format="rgb24")
    # Of a phone; PyAV's `rotation` would turn what is to be mirrored.
    if (matrix := frame.side_data.get("DISPLAYMATRIX")) is None:
        return pixels
    right, turned, _, back, down = np.sign(np.frombuffer(matrix, np.int32)[:5])
    if (right and turned) or (back and down):
        raise UnreadableError("it is shown turned by parts of a quarter: encode it upright")
    if turned:
        pixels, right, down = pixels.swapaxes(0, 1), back, turned
    return pixels[::down, ::right]


def check_opaque(pixels: NDArray[np.uint8]) -> None:
    """Raise `UnreadableError` if a pixel of an image ``[H, W, 4]`` is transparent."""
    if pixels[..., 3].min() < 255:
        raise UnreadableError("its images are transparent: put them on a background of yours")


def read_film(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of a film, or of a folder of images in the order of their names and numbers.

    Yields:
        uint8 ``[H, W, 3]``, red first.

    Raises:
        UnreadableError: If there is no such film, PyAV is missing, or frames cannot be read, are
            damaged, transparent, of more than 8 bits a color or of several sizes; if a film ends
            before its time, or images of a folder are not of one series.
    """
    if not path.exists():
        raise UnreadableError(f"there is no {path}: name a film, or a folder of images")
    shape = None
    for frame in _images_in(path) if path.is_dir() else _decoded(path):
        if shape not in (None, frame.shape):
            sizes = f"{[*shape]} and {[*frame.shape]}"
            raise UnreadableError(f"the frames in {path} differ in size, {sizes}: make them alike")
        shape = frame.shape
        yield frame
    if shape is None:
        raise UnreadableError(f"{path} has no frames: name a film, or a folder of images")


def _images_in(folder: Path) -> Iterator[NDArray[np.uint8]]:
    known = Image.registered_extensions()
    images = [file for file in folder.iterdir() if file.suffix.lower() in known]
    other = next((file for file in images if file.suffix.lower() not in _IMAGES), None)
    if other is not None:
        raise UnreadableError(f"{other} is no {', '.join(_IMAGES)}: convert it, or take it away")
    order = sorted(images, key=lambda file: _with_numbers(file, r"(\d+)"))
    by_time = sorted(images, key=lambda file: _with_numbers(file, r"(\d+\.\d+|\d+)"))
    if order != by_time:
        other = next(a for a, b in zip(order, by_time, strict=True) if a != b)
        raise UnreadableError(
            f"{other} has a point in its name, by which the order of frames is not clear: number "
            "them, as in 0001.png"
        )
    series = {re.sub(r"\d+", "0", file.name.lower()): file for file in order}
    if len(series) > 1:
        one, two, *_ = series.values()
        raise UnreadableError(
            f"{one} and {two.name} are not of one series: keep the frames of one camera in a "
            "folder, named alike, as in 0001.png"
        )
    _check_gaps(order)
    for file in order:
        with _decoding(file):
            yield decode_image(file.read_bytes())


def _check_gaps(order: Sequence[Path]) -> None:
    """Raise `UnreadableError` if some of the files that a series of numbers implies are missing."""
    numbers = [[int(part) for part in re.findall(r"\d+", file.stem)] for file in order]
    changing = [column for column in zip(*numbers, strict=True) if len({*column}) > 1]
    if len(changing) != 1:
        return
    steps = np.diff(np.array(changing[0], object))
    usual = min(steps)
    # Times of frames, as in 1700000033.png, have no common step.
    if usual and not any(steps % usual) and (steps == usual).mean() > 0.5:
        for before, after, step in zip(order, order[1:], steps, strict=False):
            if step > usual:
                raise UnreadableError(
                    f"a frame between {before} and {after.name} is missing: get it, or number "
                    "the frames anew"
                )


def _decoded(file: Path) -> Iterator[NDArray[np.uint8]]:
    with _decoding(file), importlib.import_module("av").open(str(file)) as film:
        check_depth(film.streams.video[0])
        end = None
        for frame in undamaged(film.decode(video=0)):
            end = frame.time
            yield decode_frame(frame)
        rate = film.streams.video[0].average_rate
        # Of a film with sound, the whole may be longer than what is seen.
        if end is None or not rate or not film.duration or len(film.streams) > 1:
            return
        seconds = ((film.start_time or 0) + film.duration) / 1e6
        if end + float(3 / rate) < seconds:
            raise UnreadableError(
                f"its last frame is at {end:.2f} s of {seconds:.2f} s, so the rest is missing: get "
                "it again"
            )


@contextlib.contextmanager
def _decoding(file: Path) -> Iterator[None]:
    """Turn whatever goes wrong with a file into one line."""
    check_fetched(file)
    try:
        yield
    except UnreadableError as error:
        raise UnreadableError(f"{file}: {error}") from None
    except ImportError:
        raise UnreadableError(
            f"{file} is a film: pip install av (PyAV) to decode it, or name a folder of its frames"
        ) from None
    except _UNDECODABLE as error:
        raise UnreadableError(
            f"{file} cannot be decoded: name a film, or a folder of its frames as PNG"
        ) from error


def _with_numbers(file: Path, number: str) -> list[tuple[Decimal, str]]:
    """Return a key that sorts names with their numbers as numbers: 2.png before 10.png."""
    parts = re.split(number, file.stem)
    return [(Decimal(part if at % 2 else -1), part) for at, part in enumerate(parts)]
