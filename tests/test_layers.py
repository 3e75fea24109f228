"""The parts of the package form layers: none imports from a later one."""

import ast
import functools
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "bgpo_trl"
LAYERS = (
    "files",
    "modules",
    "transforms",
    "objectives",
    "scenes",
    "data",
    "encoders",
    "algorithms",
    "runs",
    "analysis",
    "figures",
    "top",
    "experiments",
)
"""In the order of docs/design.md; ``top`` is the package itself."""
TOP = ("world", "logged", "evaluation", "training", "policy")
"""Modules and packages of ``top``, in their order."""
OPEN = ("configs", "errors", "interrupts", "seeding", "machine")
"""Open to all; they import from none of the layers."""
LAST = ("__init__", "__main__")
"""The package's face and its command line, which import from anywhere."""


@functools.cache
def imported(path: Path) -> set[str]:
    """Return what a file imports, also inside functions, but not for type checking alone."""
    tree = ast.parse(path.read_text())
    unseen = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for statement in block.body
        for node in ast.walk(statement)
    }
    found = set()
    for node in ast.walk(tree):
        if id(node) in unseen:
            continue
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def place(name: str) -> int | None:
    """Return the position of a module among the layers; None if it is open to all."""
    if name in OPEN:
        return None
    if name in TOP:
        return 100 * LAYERS.index("top") + TOP.index(name)
    return 100 * LAYERS.index(name)


FILES = {path: path.relative_to(PACKAGE).with_suffix("").parts[0] for path in PACKAGE.rglob("*.py")}


def test_every_module_belongs_to_a_layer():
    assert set(FILES.values()) == {*LAYERS, *TOP, *OPEN, *LAST} - {"top"}


def test_no_layer_imports_from_a_later_one():
    for path, name in FILES.items():
        for module in imported(path) if name not in LAST else ():
            package, _, inner = module.partition(".")
            other = inner.partition(".")[0]
            if package != "bgpo_trl" or other in ("", name):
                continue
            here, there = place(name), place(other)
            allowed = there is None or (here is not None and there < here)
            assert allowed, f"{path} imports {module}"


def test_the_suite_imports_no_learning_and_the_package_no_scripts():
    for path in (ROOT / "suites").rglob("*.py"):
        packages = {module.partition(".")[0] for module in imported(path)}
        assert not packages & {"bgpo_trl", "torch", "torchrl", "tensordict"}, path
    for path in FILES:
        packages = {module.partition(".")[0] for module in imported(path)}
        assert not packages & {"benchmarks", "examples", "tests", "scripts"}, path
        if path.name != "nico.py":
            assert not any(name.startswith("suites.nico") for name in imported(path)), path
