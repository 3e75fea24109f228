"""Command line of the doctor."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from bgpo_trl import doctor
from bgpo_trl.doctor.finding import Check, Finding, first_line
from bgpo_trl.doctor.frames import check_frame
from bgpo_trl.doctor.machine import check_device, check_disk
from bgpo_trl.doctor.speed import check_frame_rate, check_update_rate
from bgpo_trl.doctor.versions import check_versions


def examine(checks: Mapping[str, Check]) -> Iterator[Finding]:
    """Run checks one after the other; report a check that raises as a finding."""
    for name, check in checks.items():
        try:
            yield from check()
        except Exception as error:
            told = f"{type(error).__name__}: {first_line(error)}"
            yield Finding("wrong", name, f"cannot be checked ({told}): mend what is wrong above")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line (see ``--help``); return 1 if a finding is ``wrong``, else 0."""
    # Not tyro, which may be what is broken.
    parser = argparse.ArgumentParser("python -m bgpo_trl.doctor", description=doctor.__doc__)
    parser.add_argument("--frame", type=Path, metavar="PNG", help="write what the robot sees")
    frame = parser.parse_args(arguments).frame
    checks: dict[str, Check] = {
        "versions": check_versions,
        "frame": lambda: check_frame(frame),
        "frames/s": check_frame_rate,
        "updates/s": check_update_rate,
        "device": check_device,
        "disk": check_disk,
    }
    levels = []
    for finding in examine(checks):
        sys.stdout.write(f"{finding}\n")
        sys.stdout.flush()
        levels.append(finding.level)
    counts = f"{levels.count('wrong')} wrong, {levels.count('note')} to note"
    sys.stdout.write(f"\n{counts}\n" if {"wrong", "note"} & {*levels} else "\nall is well\n")
    return int("wrong" in levels)


if __name__ == "__main__":
    sys.exit(main())
