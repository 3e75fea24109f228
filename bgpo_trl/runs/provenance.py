"""Code that a run was made with: commit and versions."""

from __future__ import annotations

import importlib.metadata
import subprocess
from pathlib import Path


def commit_of_code() -> str:
    """Return the commit of this code, with ``-dirty`` if it was modified; ``""`` if unknown."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():  # An installed package may lie in another repository.
        return ""
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        result = subprocess.run(describe, cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return result.stdout.strip()


def versions() -> dict[str, str]:
    """Return the installed versions of the packages that a run depends on most."""
    packages = ("bgpo_trl", "torch", "torchrl", "mujoco")
    return {package: importlib.metadata.version(package) for package in packages}
