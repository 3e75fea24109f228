"""Check whether a refactoring has changed the results of runs.

Short runs are made before and after the change. Runs are equal if the values in their CSV files and
the tensors in their checkpoints are; names of columns and of tensors may differ.

    python scripts/regression_check.py runs/before
    python scripts/regression_check.py runs/after --against runs/before
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

_SHORT = "--preset quick --episodes 40 --seeds 0 1"
RUNS = {
    "smoke": "continual.py --preset smoke",
    "bgpo": f"continual.py {_SHORT}",
    "gwr": f"concurrent_tasks.py --algorithm without-bonus {_SHORT}",
    "maml": f"continual.py --algorithm maml {_SHORT}",
    "dist-nll": f"continual.py --algorithm dist-nll {_SHORT}",
    "clone": f"continual.py --algorithm clone {_SHORT}",
    "paper": f"continual.py --algorithm bgpo-paper {_SHORT}",
}
"""Arguments of each run, by its name."""
_TABLES = ("train.csv", "eval.csv", "final.csv")


def digest_of(run: Path) -> dict[str, Any]:
    """Return the digests of a run's tables, and of its tensors in sorted order."""
    digests: dict[str, Any] = {}
    for name in _TABLES:
        if (run / name).exists():
            with (run / name).open(newline="") as file:
                values = [sorted(row) for row in list(csv.reader(file))[1:]]
            digests[name] = hashlib.sha256(json.dumps(values).encode()).hexdigest()
    (checkpoint,) = sorted((run / "checkpoint").glob("*.pt"))[-1:]
    state = torch.load(checkpoint, weights_only=True)
    digests["tensors"] = sorted(
        hashlib.sha256(tensor.contiguous().view(-1).view(torch.uint8).numpy()).hexdigest()
        for tensor in _tensors(state)
        if tensor.numel() > 1 and tensor.is_floating_point()
    )
    return digests


def _tensors(state: Any) -> Iterator[torch.Tensor]:
    if isinstance(state, torch.Tensor):
        yield state
    elif isinstance(state, dict):
        for value in state.values():
            yield from _tensors(value)
    elif isinstance(state, list | tuple):
        for value in state:
            yield from _tensors(value)


def main() -> None:
    """Make the missing runs and compare them with the earlier ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the runs")
    parser.add_argument("--against", type=Path, help="folder of earlier runs")
    parser.add_argument("--runs", nargs="+", choices=RUNS, default=list(RUNS))
    arguments = parser.parse_args()
    benchmarks = Path(__file__).parents[1] / "benchmarks"
    failed = False
    for name in arguments.runs:
        run = arguments.out / name
        if not (run / "summary.json").exists():
            script, *options = RUNS[name].split()
            command = [sys.executable, str(benchmarks / script), *options, "--out", str(run)]
            subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        digests = digest_of(run)
        if arguments.against is None:
            continue
        before = digest_of(arguments.against / name)
        changed = [table for table in _TABLES if digests.get(table) != before.get(table)]
        missing = Counter(before["tensors"]) - Counter(digests["tensors"])
        if missing:
            changed.append(f"{missing.total()} of {len(before['tensors'])} tensors")
        failed |= bool(changed)
        print(f"{name}: {'changed: ' + ', '.join(changed) if changed else 'equal'}")
    sys.exit(failed)


if __name__ == "__main__":
    main()
