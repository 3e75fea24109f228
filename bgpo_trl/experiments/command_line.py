"""Command lines: a function of one dataclass of arguments, called with those that are given."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import os
import signal
import sys
import sysconfig
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

import tyro

from bgpo_trl.configs import PRESETS, RepresentationConfig
from bgpo_trl.experiments.arguments import SETTINGS, Arguments, EncodersArguments


def command_line(
    command: Callable[..., str | None],
    options: Sequence[str] | None = None,
    *,
    kind: type | None = None,
    program: str | None = None,
    line: str = "",
) -> None:
    """Call a function with the arguments of the command line, and print what it returns.

    The module that ``--import`` names is imported first.

    An expected error becomes one line. Ctrl-C and SIGTERM exit with 75 (``os.EX_TEMPFAIL``) if
    ``--resume`` can continue. An error of somebody else's code, such as a module named with
    ``--import``, keeps its traceback.

    Args:
        command: Function of one dataclass, ``arguments``.
        options: Arguments; by default those of the process.
        kind: The dataclass, by default the annotated one. ``--help`` shows its docstring.
        program: Name of the program in messages; by default that of the process.
        line: First line of the help.
    """
    asked: type = get_type_hints(command)["arguments"] if kind is None else kind
    resumable = hasattr(asked, "resume")
    try:
        with _terminable() if resumable else contextlib.nullcontext(), _plain_warnings():
            try:
                arguments = _parse(asked, options, program, line)
            except BrokenPipeError:  # of --help, by `| head`; the exit flushes once more
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                sys.exit(1)
            import_plugin(getattr(arguments, "module", None))
            text = command(arguments)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        if _is_of_others(error):
            raise
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        if not resumable:
            again = getattr(asked, "same_command_continues", False)
            sys.exit("interrupted" + ": the same command continues" * again)
        sys.stderr.write("interrupted: the same command with --resume continues\n")
        sys.exit(os.EX_TEMPFAIL)
    if text is not None:
        sys.stdout.write(f"{text}\n")


def import_plugin(module: str | None) -> None:
    """Import the user's module, if there is a name, from the current folder or installed.

    It may add tasks with `suites.nico.add_task`, and entries to `bgpo_trl.scenes.SCENES`,
    `bgpo_trl.algorithms.ALGORITHMS` and `bgpo_trl.modules.frame_network.FRAME_NETWORKS`.

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


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Have SIGTERM raise ``KeyboardInterrupt`` in all stages of a run, not in training alone."""
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextlib.contextmanager
def _plain_warnings() -> Iterator[None]:
    """Write this package's warnings as one line each, without the line of code."""
    usual, package = warnings.formatwarning, Path(__file__).parents[1]

    def format_one(message: Any, category: Any, filename: str, *place: Any, **line: Any) -> str:
        if Path(filename).is_relative_to(package):
            return f"warning: {message}\n"
        return usual(message, category, filename, *place, **line)

    warnings.formatwarning = format_one
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _parse(kind: type, options: Sequence[str] | None, program: str | None, line: str) -> Any:
    """Return the arguments; flags of single settings are left to `run_config`."""
    description = "\n\n".join(filter(None, (line, inspect.getdoc(kind))))
    options = sys.argv[1:] if options is None else options
    parse: Any = partial(tyro.cli, kind, prog=program, description=description, args=options)
    if not issubclass(kind, Arguments):
        arguments = parse()
        if isinstance(arguments, EncodersArguments) and arguments.settings is not None:
            # Here, since help and messages need no torch.
            from bgpo_trl.runs.config_file import read_encoder_settings

            read = read_encoder_settings(arguments.settings, RepresentationConfig())
            return parse(default=replace(arguments, config=read))
        return arguments
    if {"-h", "--help"} & {*options}:
        with contextlib.suppress(SystemExit):
            parse()
        described = "Settings, with the defaults of --preset quick and --algorithm bgpo:"
        quick = PRESETS["quick"]
        tyro.cli(SETTINGS, prog=program, description=described, default=quick, args=["--help"])
    arguments, rest = parse(return_unknown_args=True)
    return replace(arguments, settings=tuple(rest))


def _is_of_others(error: BaseException) -> bool:
    """Return whether code raised an error, or called the library that did, which is not ours."""
    paths = [Path(frame.filename) for frame in traceback.extract_tb(error.__traceback__)]
    libraries = [Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib")]
    package = Path(__file__).parents[1]
    ours = [package, package.parent / "suites", package.parent / "benchmarks"]
    for path in reversed(paths):
        if any(path.is_relative_to(folder) for folder in ours):
            return False
        if path.exists() and not any(path.is_relative_to(folder) for folder in libraries):
            return True
    return False
