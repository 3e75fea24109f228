"""Make one small mistake at a time in the package, and see whether its tests catch it.

A mistake is drawn at random from all places where the code can be altered: another comparison,
sign, number or truth value, a negated condition, a statement or an argument left out, None
returned. Folders have mistakes in proportion to their places. The tests that reach the mistaken
line are run, at first those that coverage names, then the whole of their files. A mistake that none
of them notices has survived; it may be one that changes nothing, so survivors have to be read. A
test that also fails without the mistake has caught nothing, and is named.

The checkout is altered while it runs: use a clone. Coverage is measured first:

    pip install pytest-cov
    pytest -n 2 --dist loadfile --cov=bgpo_trl --cov-context=test --cov-report=
    python scripts/mutations.py --number 200 --out mutations.csv
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import csv
import os
import random
import signal
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

PACKAGE = Path("bgpo_trl")
_OTHER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
_TIMEOUT = 600  # seconds


@dataclass(frozen=True)
class Mutation:
    """A place in a file, and what replaces it."""

    path: Path
    start: tuple[int, int]
    end: tuple[int, int]
    after: str

    @property
    def lines(self) -> range:
        """The lines that it alters, from 1."""
        return range(self.start[0], self.end[0] + 1)

    def parted(self, source: str) -> tuple[str, str, str]:
        """Return the file before the place, there and behind it."""
        lines = source.encode().splitlines(keepends=True)
        start, end = (
            sum(map(len, lines[: line - 1])) + column for line, column in (self.start, self.end)
        )
        whole = b"".join(lines)
        return whole[:start].decode(), whole[start:end].decode(), whole[end:].decode()

    def applied(self, source: str) -> str:
        """Return the file with the mistake."""
        head, _, tail = self.parted(source)
        return head + self.after + tail


def _replacements(node: ast.AST) -> Iterator[str]:
    """Yield what can stand in the place of a node."""
    match node:
        case ast.Compare(left, [op, *ops], comparators) if type(op) in _OTHER:
            other = _OTHER[type(op)]()
            yield ast.unparse(ast.Compare(left, [other, *ops], comparators))
        case ast.BinOp(left, op, right) if type(op) in _OTHER:
            yield f"({ast.unparse(ast.BinOp(left, _OTHER[type(op)](), right))})"
        case ast.BoolOp(op, values):
            yield f"({ast.unparse(ast.BoolOp(_OTHER[type(op)](), values))})"
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            yield f"({ast.unparse(operand)})"
        case ast.Constant(bool(value)):
            yield str(not value)
        case ast.Constant(int() | float() as value):
            yield str(value + 1)
        case ast.IfExp(test, body, orelse):
            yield f"({ast.unparse(ast.IfExp(test, orelse, body))})"
        case ast.Return(value) if value and not isinstance(value, ast.Constant):
            yield "return None"
        case ast.Expr(ast.Call()) | ast.AugAssign():
            yield "pass"
        case ast.Assign([ast.Attribute() | ast.Subscript()]):
            yield "pass"
        case ast.Call(func, args, [*keywords, last]) if last.arg:
            yield ast.unparse(ast.Call(func, args, keywords))


def mutations(path: Path) -> list[Mutation]:
    """Return all mistakes that can be made in a file, in the order of their places."""
    tree = ast.parse(path.read_text())
    inert: set[int] = set()  # annotations, decorators and messages
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                inner = [*node.decorator_list, getattr(node, "returns", None)]
            case ast.arg(_, annotation) | ast.AnnAssign(_, annotation):
                inner = [annotation]
            case ast.Raise() | ast.JoinedStr():
                inner = [*ast.iter_child_nodes(node)]
            case _:
                inner = []
        inert |= {id(child) for part in inner if part for child in ast.walk(part)}
    found = []
    for node in ast.walk(tree):
        if id(node) in inert:
            continue
        tests = [node.test] if isinstance(node, ast.If | ast.While) else []
        places = [(node, text) for text in _replacements(node)]
        places += [(test, f"not ({ast.unparse(test)})") for test in tests]
        for place, after in places:
            assert isinstance(place, ast.expr | ast.stmt)
            assert place.end_lineno is not None and place.end_col_offset is not None
            start, end = (place.lineno, place.col_offset), (place.end_lineno, place.end_col_offset)
            found.append(Mutation(path, start, end, after))
    return sorted(found, key=lambda mutation: (mutation.start, mutation.end, mutation.after))


def sample(number: int, seed: int) -> list[Mutation]:
    """Draw mistakes from all files alike; each folder has at least one."""
    folders = defaultdict(list)
    for path in sorted(PACKAGE.rglob("*.py")):
        folders[path.parent] += mutations(path)
    folders = {folder: places for folder, places in folders.items() if places}
    total = sum(len(places) for places in folders.values())
    generator = random.Random(seed)
    return [
        mutation
        for places in folders.values()
        for mutation in generator.sample(places, max(1, round(number * len(places) / total)))
    ]


def reaching_tests(mutation: Mutation) -> list[str]:
    """Return the tests that run a line of the mistake, those of its own folder first."""
    from coverage import CoverageData

    data = CoverageData()
    data.read()
    contexts = data.contexts_by_lineno(str(mutation.path.resolve()))
    names = {name for line in mutation.lines for name in contexts.get(line, [])}
    if "" in names:  # run on import
        names |= {name for many in contexts.values() for name in many}
    tests = {name.rpartition("|")[0] for name in names} - {""}  # without "|setup", "|run"
    own = f"tests/{mutation.path.parent.name}/"
    return sorted(tests, key=lambda test: (not test.startswith(own), test))


class FirstFailure:
    """A pytest plugin that writes the name of the first failure to a pipe."""

    def __init__(self, pipe: int) -> None:
        self.pipe = pipe

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note a test, or its fixture, that fails."""
        if report.failed:
            os.write(self.pipe, report.nodeid.encode() + b"\n")

    pytest_collectreport = pytest_runtest_logreport


def failing(tests: list[str]) -> list[str]:
    """Run tests in a process of its own; return the first that fails, or none.

    All are returned if none could be run, or the time was over.
    """
    import pytest

    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 1)
            os.dup2(nothing.fileno(), 2)
        signal.alarm(_TIMEOUT)
        options = ["-x", "-q", "-p", "no:cacheprovider", *tests]
        os._exit(int(pytest.main(options, plugins=[FirstFailure(writer)])))
    os.close(writer)
    _, status = os.waitpid(child, 0)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what the tests have started
    with open(reader) as pipe:
        first = pipe.readline().strip()
    if status == 0:
        return []
    return [first] if first else tests


def verdict(mutation: Mutation) -> str:
    """Make the mistake, run its tests and undo it."""
    tests = reaching_tests(mutation)
    if not tests:
        return "not run"
    files = list(dict.fromkeys(test.partition("::")[0] for test in tests))
    source = mutation.path.read_text()
    mutation.path.write_text(mutation.applied(source))
    try:
        failed = failing(tests) or failing(files)
    finally:
        mutation.path.write_text(source)
    if failed and (without := failing(failed)):
        return f"{without[0]} fails without it"
    return "caught" if failed else "survived"


def main() -> None:
    """Write one line for each mistake to a CSV file; go on where it ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    # Once, before the processes of the tests part from this one.
    for name in ("pytest", "torchrl.envs", "torchrl.objectives", "dm_control.rl.control"):
        import_module(name)
    drawn = sample(arguments.number, arguments.seed)
    done = len(arguments.out.read_text().splitlines()) - 1 if arguments.out.exists() else -1
    with arguments.out.open("a", newline="") as file:
        writer = csv.writer(file)
        if done < 0:
            writer.writerow(["file", "line", "before", "after", "verdict"])
        for mutation in drawn[max(done, 0) :]:
            texts = mutation.parted(mutation.path.read_text())[1], mutation.after
            before, after = (" ".join(text.split()) for text in texts)
            row = [mutation.path, mutation.start[0], before, after, verdict(mutation)]
            writer.writerow(row)
            file.flush()
            sys.stdout.write(f"{row[0]}:{row[1]} {row[-1]}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
