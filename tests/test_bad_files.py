"""Wrong files: each is refused in one line, and nothing is left half-written."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.dataset import load_demonstrations
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.pretrained import default_weights, load_pretrained
from bgpo_trl.encoders.representation import load_representation
from bgpo_trl.figures.frames import plot_frame_strips
from bgpo_trl.figures.style import save_figure
from bgpo_trl.files.checkpoint import save_checkpoint
from bgpo_trl.files.csv_file import CsvFile
from bgpo_trl.runs.directory import RunLogger
from bgpo_trl.runs.results import COLUMNS, read_json, read_run
from suites import nico
from tests.scenes.dot import scene

HEADER = ",".join(COLUMNS["eval.csv"]) + "\n"
CONFIG = {"seeds": [0], "tasks": nico.PAPER_TASKS, "task_starts": [0, 0, 0], "episodes": 10}
TINY = {"per_task": 2, "held_out_per_task": 1, "progress": False}


@pytest.fixture
def folder(tmp_path) -> Path:
    """A file, a bank, and runs with damaged or foreign files."""
    (tmp_path / "file").write_text("x")
    for name, content in {
        "unevaluated": HEADER,
        "foreign": "date,temperature\nmonday,21\n",
        "binary": b"\xff\xfe\x00" * 20,
    }.items():
        (tmp_path / name).mkdir()
        data = content if isinstance(content, bytes) else content.encode()
        (tmp_path / name / "eval.csv").write_bytes(data)
        (tmp_path / name / "config.json").write_text(json.dumps(CONFIG))
    bank().save(tmp_path / "bank")
    return tmp_path


def bank() -> DemonstrationBank:
    task = torch.arange(3)
    return DemonstrationBank(torch.zeros(3, 32), task, task > 0, nico.PAPER_TASKS, encoder_id="x")


def load_bank(path):
    return DemonstrationBank.load(path, encoder_id="x")


def figure():
    return plot_frame_strips({"a": np.zeros((2, 32, 64, 3), np.uint8)})


def log(path, **options):
    RunLogger(path, **({"config": {}} | options)).close()


CASES = {
    # run directories
    "run in a file": (
        lambda f: log(f / "file"), "cannot make the folder", "File exists): choose another"),
    "run that has only tests": (
        lambda f: log(f / "unevaluated"), "already holds a run", "resume it, or choose another"),
    "csv that is a folder": (lambda f: CsvFile(f, ["a"]), "Is a directory", "choose another run"),
    "csv of binary data": (
        lambda f: CsvFile(f / "binary" / "eval.csv", [*COLUMNS["eval.csv"]]),
        "not with the columns algorithm,seed", "choose another run directory"),
    "figure in a file": (
        lambda f: save_figure(figure(), f / "file" / "a.png"), "cannot make the folder", "another"),
    # checkpoints
    "checkpoint in a file": (
        lambda f: save_checkpoint(f / "file", {"a": 1}), "cannot save a checkpoint", "make room"),
    # runs that are read
    "no run": (lambda f: read_run(f / "nowhere"), "there is no run at", "name another"),
    "table of something else": (
        lambda f: read_run(f / "foreign"),
        "lacks the columns algorithm, seed, episode", "name another run"),
    "no settings": (lambda f: read_json(f / "config.json"), "is missing", "let the run in"),
    # encoders and bank
    "no encoders": (
        lambda f: load_pretrained(f / "a.safetensors"), "no encoder weights", "--train-encoders"),
    "encoders that are a picture": (
        lambda f: load_representation(f / "file"), "damaged or holds no", "--train-encoders"),
    "a bank for encoders": (
        lambda f: load_representation(f / "bank"), "damaged or holds no", "--train-enc"),
    "encoders of another scene": (
        lambda f: load_representation(default_weights(), scene=scene()), "this is dot dot-1",
        "--scene nico"),
    "no bank": (lambda f: load_bank(f / "a"), "there is no demonstration bank", "--train-encoders"),
    "encoders for a bank": (
        lambda f: load_bank(default_weights()), "not a bank", "--train-encoders"),
    "bank of other encoders": (
        lambda f: DemonstrationBank.load(f / "bank", encoder_id="y"),
        "by the encoders x, not by y", "--train-encoders"),
    "bank in no folder": (
        lambda f: bank().save(f / "file" / "b"), "cannot make the", "another"),
    # demonstrations
    "no dataset": (
        lambda f: load_demonstrations(f / "nowhere"), "there is no dataset", "record it again"),
    "recording into a file": (
        lambda f: record_demonstrations(f / "file", **TINY), "cannot make the folder", "another"),
    "recording of no task": (
        lambda f: record_demonstrations(f / "d", tasks=[], **TINY), "tasks", "name at least one"),
    "recording an unknown task": (
        lambda f: record_demonstrations(f / "d", tasks=["juggle"], **TINY), "'juggle'", "choose"),
}  # fmt: skip


@pytest.mark.parametrize(("call", "cause", "remedy"), CASES.values(), ids=CASES.keys())
def test_a_bad_file_is_refused_and_nothing_changes(folder, refused, call, cause, remedy):
    refused(lambda: call(folder), cause, remedy)
