"""Snapshots of the GWR-B graph during a run."""

from __future__ import annotations

import os
import re
from pathlib import Path

import torch

from bgpo_trl.files.tensor_file import load_tensors, save_tensors
from bgpo_trl.modules.gwr import GWRB

_NAME = re.compile(r"episode-(\d+)\.safetensors")


def growth_moments(episodes: int, count: int = 6) -> list[int]:
    """Return evenly spaced training episodes after which to save a graph, the last included.

    Examples:
        >>> growth_moments(1200), growth_moments(3)
        ([200, 400, 600, 800, 1000, 1200], [1, 2, 3])
    """
    return sorted({-(-episodes * (i + 1) // count) for i in range(count)})


def save_graph(directory: str | os.PathLike[str], episode: int, gwr: GWRB) -> Path:
    """Write the first network atomically as ``episode-{episode}.safetensors``.

    The tensors are those of `BehaviorGraph` and ``next_node``, the id of the next node created.

    Args:
        directory: Folder of the snapshots, made if missing.
        episode: Number of training episodes so far.
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
    """Read the graphs written by `save_graph`, keyed by training episode in increasing order.

    Returns:
        Single networks; empty if there are no snapshots.

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
        raise ValueError(f"{path} is damaged or not a graph of GWR-B: remove it") from error
    return gwr
