"""Check of Python, the dependencies and the extras."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Callable, Iterator
from pathlib import Path

from bgpo_trl.doctor.finding import Finding

CONSTRAINTS = Path(__file__).parents[2] / "constraints.txt"
"""Exact versions known to work together; exists in a checkout only."""


def judge_version(
    name: str, found: str | None, wanted: str, exact: str | None = None, *, optional: bool = False
) -> Finding:
    """Judge the version of a dependency.

    Args:
        name: Name of its distribution.
        found: The installed version; None if it is not installed.
        wanted: The supported range, such as ``">=2.13,<3"``.
        exact: The version known to work, or None.
        optional: Whether most runs do not need it.
    """
    from packaging.specifiers import SpecifierSet

    remedy = f"pip install '{name}{wanted}'" if exact is None else f"pip install {name}=={exact}"
    if found is None:
        if optional:
            return Finding("ok", name, f"not installed, optional: pip install 'bgpo_trl[{name}]'")
        return Finding("wrong", name, f"not installed: {remedy}")
    if not SpecifierSet(wanted).contains(found, prereleases=True):
        level = "note" if optional else "wrong"
        return Finding(level, name, f"{found} is outside {wanted}: {remedy}")
    # A build label, such as +cpu or +cu128, does not count.
    if exact is not None and found.partition("+")[0] != exact:
        return Finding("note", name, f"{found}, known to work is {exact}; if in doubt: {remedy}")
    return Finding("ok", name, found)


def judge_python(found: str, wanted: str) -> Finding:
    """Judge the version of Python by the range of the package."""
    from packaging.specifiers import SpecifierSet

    if SpecifierSet(wanted).contains(found, prereleases=True):
        return Finding("ok", "python", f"{found}, {platform.system()} {platform.machine()}")
    return Finding("wrong", "python", f"{found} is outside {wanted}: make .venv with another one")


def read_constraints(path: Path) -> dict[str, str]:
    """Return the versions in a ``constraints.txt`` by name; none if there is no such file."""
    if not path.is_file():
        return {}
    lines = (line.partition("#")[0].strip() for line in path.read_text().splitlines())
    pairs = (line.partition("==") for line in lines if "==" in line)
    return {name.strip(): version.strip() for name, _, version in pairs}


def installed_version(name: str) -> str | None:
    """Return the version of a distribution, or None."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def check_versions(
    version: Callable[[str], str | None] = installed_version,
    constraints: Path = CONSTRAINTS,
) -> Iterator[Finding]:
    """Check Python, all dependencies, and the extras that a run can use."""
    from packaging.requirements import Requirement

    try:
        distribution = importlib.metadata.distribution("bgpo_trl")
    except importlib.metadata.PackageNotFoundError:
        yield Finding("wrong", "bgpo_trl", "not installed: pip install -c constraints.txt -e .")
        return
    yield judge_python(platform.python_version(), distribution.metadata["Requires-Python"])
    exact = read_constraints(constraints)
    seen = set()
    for line in distribution.requires or ():
        wanted = Requirement(line)
        optional = wanted.marker is not None
        if wanted.name in seen or (optional and wanted.name not in ("wandb", "ray")):
            continue  # named by two extras, or for those who work on the package
        seen.add(wanted.name)
        known = exact.get(wanted.name)
        found = version(wanted.name)
        yield judge_version(wanted.name, found, str(wanted.specifier), known, optional=optional)
