"""Files that wandb writes in its offline mode."""

import hashlib
import json
import os
import struct
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import wandb
from PIL import Image
from wandb.proto.wandb_internal_pb2 import Record

from bgpo_trl.figures.frames import save_gif
from bgpo_trl.figures.style import save_figure
from bgpo_trl.figures.success import plot_success_curves
from bgpo_trl.runs.dashboard import wandb_logger
from bgpo_trl.runs.directory import flatten
from bgpo_trl.runs.results import read_run
from tests.helpers import interrupt

pytestmark = pytest.mark.usefixtures("easy_world")
TASKS = ("grasp_glass", "push_green_to_glass", "push_green_to_white")


@pytest.fixture(scope="module", autouse=True)
def own_wandb(tmp_path_factory):
    """Isolate wandb from its other users and from any server."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith("WANDB_")]:
            patch.delenv(name)
        for name in ("CACHE", "CONFIG", "DATA", "ARTIFACT"):
            patch.setenv(f"WANDB_{name}_DIR", str(home))
        patch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # where nothing answers
        patch.setenv("WANDB_SILENT", "true")
        wandb.teardown()
        yield
        wandb.teardown()


def records(file: Path) -> list[Record]:
    """Read a ``.wandb`` file: LevelDB's log format after a header of 7 bytes.

    Pieces of records, each after its checksum, size and kind (1: whole, 2: first, 3: middle,
    4: last), in blocks of 32 KiB. wandb has no reader in Python.
    """
    data = file.read_bytes()
    assert data.startswith(b":W&B")
    at, content, found = 7, b"", []
    while at + 7 <= len(data):
        left = 2**15 - at % 2**15
        if left < 7:
            at += left
            continue
        _, size, kind = struct.unpack_from("<IHB", data, at)
        content += data[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):
            found.append(Record.FromString(content))
            content = b""
    return found


def sessions(directory: Path) -> list[list[Record]]:
    """Return the records of each process that worked on the run, first to last.

    wandb writes them in a process of its own, which may end after the call that finishes the run.
    """
    files = [*directory.glob("wandb/offline-run-*/*.wandb")]
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not all(
        any(record.WhichOneof("record_type") == "exit" for record in records(file))
        for file in files
    ):
        time.sleep(0.1)
    return [records(file) for file in sorted(files, key=lambda file: file.stat().st_mtime_ns)]


def values(items) -> dict[str, Any]:
    """Return the values of a record by their names."""
    return {"/".join(item.nested_key) or item.key: json.loads(item.value_json) for item in items}


def history(session: list[Record]) -> list[dict[str, Any]]:
    """Return what was logged together."""
    return [values(record.history.item) for record in session if record.HasField("history")]


def step_metrics(session: list[Record]) -> dict[str, str]:
    """Return the step metric of each curve."""
    metrics = [record.metric for record in session if record.HasField("metric")]
    return {metric.name: metric.step_metric for metric in metrics if metric.step_metric}


@pytest.fixture(scope="module")
def run(easy_world, begin, make_config, tmp_path_factory):
    """A whole run that was interrupted once, with a figure and a video at its end."""
    directory = tmp_path_factory.mktemp("runs") / "run"
    start = partial(wandb_logger, directory, "offline", group="continual-bgpo", tags=["bgpo"])
    config = make_config("state", "ddpg")
    with begin(directory, config, loggers=[start]) as interrupted:
        interrupt(interrupted, 12)
    with begin(directory, config, loggers=[start], resume=True) as resumed:
        resumed.run()
        final = pd.DataFrame({"task": TASKS, "success": [0.5, 0.25, 0.75]})
        resumed.dashboard.log_final(final, 10)
        figures = directory / "figures"
        save_figure(plot_success_curves({"DDPG": read_run(directory)}), figures / "success.png")
        frames = np.random.default_rng(0).integers(256, size=(6, 32, 64, 3), dtype=np.uint8)
        save_gif(frames, figures / "grasp_glass.gif")
        for path in sorted(figures.iterdir()):
            resumed.dashboard.log_media(f"figures/{path.stem}", path)
    return directory


def test_curves_are_drawn_over_training_episodes_of_both_sessions(run):
    tests = pd.read_csv(run / "eval.csv").groupby("episode")["success"].mean()
    logged = {}
    for session in sessions(run):
        drawn_over = step_metrics(session)
        for row in history(session):
            if "eval/success_mean" in row:
                steps = {drawn_over[key] for key in row if "/" in key and not key.endswith("/step")}
                (episode,) = {row[step] for step in steps}
                logged[episode] = row["eval/success_mean"]
    assert logged == pytest.approx(tests.to_dict())
    assert list(logged) == [2, 4, 6, 8, 10]
    last = [record.summary.update for record in sessions(run)[-1] if record.HasField("summary")]
    summary = {name: value for items in last for name, value in values(items).items()}
    assert summary["eval/success_mean"] == pytest.approx(tests[10])
    assert summary["final/success_mean"] == pytest.approx(0.5)


def test_both_sessions_belong_to_the_same_run_with_its_settings(run):
    settings = dict(flatten(json.loads((run / "config.json").read_text())))
    identities = set()
    for session in sessions(run):
        (started,) = [record.run for record in session if record.HasField("run")]
        identities.add(started.run_id)
        assert (started.resume, started.run_group) == (True, "continual-bgpo")
        assert [*started.tags] == ["bgpo"]
        saved = {
            name: value
            for record in session
            if record.HasField("config")
            for name, value in values(record.config.update).items()
        }
        assert {"commit", "versions.torch"} <= saved.keys()
        for name, value in settings.items():
            assert saved[name] == (json.dumps(value) if isinstance(value, list) else value)
    assert len(identities) == 1


def test_all_files_are_in_the_run_and_name_no_place_of_this_machine(run):
    assert {path.name for path in run.parent.iterdir()} == {"run"}
    assert {path.name for path in run.iterdir()} >= {"wandb", "train.csv"}
    uploaded = [*run.glob("wandb/offline-run-*/*.wandb")]
    uploaded += [path for path in run.glob("wandb/offline-run-*/files/**/*") if path.is_file()]
    assert len(uploaded) >= 4
    for path in uploaded:
        content = path.read_bytes()
        for place in (run.parent, Path.cwd(), Path.home(), sys.prefix, sys.executable):
            assert len(str(place)) < 2 or str(place).encode() not in content


def test_figures_and_videos_are_uploaded_as_they_are(run):
    media = {}
    for row in history(sessions(run)[-1]):
        for key, value in row.items():
            name, _, part = key.rpartition("/")
            if name.startswith("figures/"):
                media.setdefault(name, {})[part] = value
    assert {name: entry["_type"] for name, entry in media.items()} == {
        "figures/success": "image-file",
        "figures/grasp_glass": "video-file",
    }
    files = sorted(run.glob("wandb/offline-run-*"))[-1] / "files"
    for name, suffix in (("success", ".png"), ("grasp_glass", ".gif")):
        sent = (files / media[f"figures/{name}"]["path"]).read_bytes()
        assert sent == (run / "figures" / f"{name}{suffix}").read_bytes()
        assert media[f"figures/{name}"]["sha256"] == hashlib.sha256(sent).hexdigest()
    with Image.open(run / "figures" / "grasp_glass.gif") as video:
        assert video.n_frames == 6
