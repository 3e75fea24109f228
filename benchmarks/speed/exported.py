"""Time of an action: of a trained policy, and of the programs that it exports.

    python benchmarks/speed/exported.py RUN

That of ONNX needs the extra ``onnx``. All map a frame to an action, arrays of NumPy, on one thread
of the CPU, and take turns. Times are CPU times, which other work on the machine lengthens less. The
policy is conditioned on noise, and sees noise: what it computes is the same for all frames.
"""

from __future__ import annotations

import importlib.util
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from timing import Timing, interleave, ratio

from bgpo_trl.analysis.tables import markdown
from bgpo_trl.experiments.arguments import ImportArguments
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.machine import set_threads
from bgpo_trl.policy import TrainedPolicy, load_run

Act = Callable[[np.ndarray], np.ndarray]
"""Maps a frame uint8 ``[H, W, 3]`` to an action float32 ``[A]``."""


@dataclass(frozen=True)
class Arguments(ImportArguments):
    """Time the actions of a trained policy and of the programs that it exports."""

    run: tyro.conf.Positional[Path]
    """Run directory."""
    frames: int = 20
    """Frames per round."""
    rounds: int = 40
    """Timing rounds."""


def contenders(policy: TrainedPolicy, folder: Path) -> dict[str, Act]:
    """Return the ways to an action, by name.

    Args:
        policy: The policy, which has seen a demonstration.
        folder: Folder for the exported programs.
    """
    policy.export(folder / "policy.pt2")
    program = torch.export.load(folder / "policy.pt2").module()

    def exported(frame: np.ndarray) -> np.ndarray:
        return program(torch.from_numpy(frame)).numpy()

    found: dict[str, Act] = {"TrainedPolicy.act": policy.act, "exported program": exported}
    if importlib.util.find_spec("onnxruntime"):
        policy.export(folder / "policy.onnx")
        runtime = importlib.import_module("onnxruntime")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = 1
        session = runtime.InferenceSession(folder / "policy.onnx", options)
        found["ONNX model"] = lambda frame: session.run(None, {"frame": frame})[0]
    return found


def measure(
    acts: Mapping[str, Act], frames: Sequence[np.ndarray], rounds: int
) -> dict[str, list[float]]:
    """Return the CPU times of an action (s), one per round, by contender."""
    calls = {name: lambda act=act: [act(frame) for frame in frames] for name, act in acts.items()}
    times = interleave(calls, rounds=rounds, clock=time.process_time)
    return {name: [seconds / len(frames) for seconds in found] for name, found in times.items()}


def main(arguments: Arguments) -> None:
    """Print the table."""
    set_threads(1)
    policy = load_run(arguments.run)
    shape = (arguments.frames, *policy.encoders.frame_network.frame_shape, 3)
    frames = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    policy.condition(frames)
    with tempfile.TemporaryDirectory() as folder:
        times = measure(contenders(policy, Path(folder)), list(frames), arguments.rounds)
    rows = [["", "ms an action", "times TrainedPolicy.act"]]
    for name, found in times.items():
        rows.append([name])
        for of, unit in ((Timing.of(found), 1e3), (ratio(found, times["TrainedPolicy.act"]), 1)):
            rows[-1].append(f"{of.median * unit:.2f} ({of.low * unit:.2f}-{of.high * unit:.2f})")
    print(markdown(rows))


if __name__ == "__main__":
    command_line(main)
