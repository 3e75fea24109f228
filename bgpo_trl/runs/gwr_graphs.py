"""The graph of GWR-B at some moments of a run, kept to see how it grew."""

from __future__ import annotations

import os
import re
from pathlib import Path

import torch

from bgpo_trl.files.tensor_file import load_tensors, save_tensors
from bgpo_trl.modules.gwr import GWRB

_NAME = re.compile(r"episode-(\d+)\.safetensors")


def growth_moments(episodes: int, count: int = 6) -> list[int]:
    """Returns the training episodes after which a graph is kept, evenly spaced, the last included.

    Example:
        >>> growth_moments(1200), growth_moments(3)
        ([200, 400, 600, 800, 1000, 1200], [1, 2, 3])
    """
    return sorted({-(-episodes * (i + 1) // count) for i in range(count)})


def save_graph(directory: str | os.PathLike[str], episode: int, gwr: GWRB) -> Path:
    """Writes the first network as ``episode-{episode}.safetensors``, whole or not at all.

    The tensors are those of `BehaviorGraph`, and ``next_node``, the identity due next.

    Args:
        directory: Made if it does not exist.
        episode: Training episodes that the network has learned from.
        gwr: The network(s).

    Raises:
        OSError: If the file cannot be written.
    """
    graph = gwr.get_extra_state()[0]
    tensors = {key: torch.as_tensor(value) for key, value in graph.items()}
    path = Path(directory) / f"episode-{episode:06d}.safetensors"
    save_tensors(path, tensors, {})
    return path


def load_graphs(directory: str | os.PathLike[str]) -> dict[int, GWRB]:
    """Reads what `save_graph` wrote, by training episode in increasing order.

    Returns:
        Single networks; empty where nothing was kept.

    Raises:
        ValueError: If a file is damaged.
    """
    paths = {path: _NAME.fullmatch(path.name) for path in Path(directory).glob("episode-*")}
    numbers = {int(match[1]): path for path, match in paths.items() if match}
    return {episode: _load(numbers[episode]) for episode in sorted(numbers)}


def _load(path: Path) -> GWRB:
    try:
        graph, _ = load_tensors(path)
        gwr = GWRB(graph["weights"].shape[1])
        gwr.set_extra_state([{**graph, "next_node": int(graph["next_node"])}])
    except (ValueError, KeyError, IndexError, OSError) as error:
        raise ValueError(f"{path} is damaged or no graph of GWR-B: remove it") from error
    return gwr
