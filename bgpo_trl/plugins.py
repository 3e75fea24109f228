"""Import of a module that adds tasks or algorithms, for ``--import`` on command lines."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path


def import_plugin(module: str | None) -> None:
    """Import the user's module, from the current folder or installed.

    It may add tasks with `suites.nico.add_task`, and entries to `bgpo_trl.scenes.SCENES`,
    `bgpo_trl.algorithms.ALGORITHMS` and `bgpo_trl.modules.frame_network.FRAME_NETWORKS`.

    Args:
        module: Name of the module; nothing is imported if None.

    Raises:
        ValueError: If there is no such module, or another one has its name.
    """
    if module is None:
        return
    folder = str(Path.cwd())
    missing = ValueError(
        f"--import {module}: there is no such module in {folder} or installed; give the name "
        "without .py, such as my_tasks"
    )
    names = module.split(".")
    if not all(name.isidentifier() for name in names):
        raise missing
    if folder not in sys.path:  # `python script.py` has the script's folder there instead
        sys.path.append(folder)
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # The module exists, and imports one that does not.
        raise missing from None
    here, there = Path(folder, *names).with_suffix(".py"), found.__file__
    if here.exists() and there is not None and not here.samefile(there):
        raise ValueError(f"--import {module}: {there} has the same name: rename {here}")
