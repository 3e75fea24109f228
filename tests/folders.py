"""Contents of a folder, to be compared before and after a call."""

from pathlib import Path


def contents(folder: Path) -> dict[Path, bytes | None]:
    """Return all that lies below a folder: the bytes of each file, None for a folder."""
    return {
        path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))
    }
