import shutil
from pathlib import Path

import pytest

from bgpo_trl.data.recording import record_demonstrations


@pytest.fixture(scope="session")
def recorded(tmp_path_factory) -> Path:
    """A small dataset: two demonstrations of each task to learn from, and one held out."""
    path = tmp_path_factory.mktemp("recorded") / "made" / "by" / "recording"
    record_demonstrations(path, per_task=3, held_out_per_task=1, progress=False)
    return path


@pytest.fixture
def copy(recorded, tmp_path) -> Path:
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(recorded, tmp_path / "copy"))
