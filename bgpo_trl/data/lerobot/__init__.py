"""Demonstrations in LeRobot's format, version 3 (https://huggingface.co/docs/lerobot).

A folder holds a row for each frame in ``data/*/*.parquet``, with images as PNG files in a column,
and in ``meta/`` the features, the tasks, the episodes and statistics. Needs the extra ``lerobot``.
"""

import importlib.util

if importlib.util.find_spec("pyarrow") is None:
    raise ImportError("LeRobot's format needs pyarrow: pip install 'bgpo_trl[lerobot]'")

from bgpo_trl.data.lerobot.reading import read_lerobot
from bgpo_trl.data.lerobot.writing import write_lerobot

__all__ = ["read_lerobot", "write_lerobot"]
