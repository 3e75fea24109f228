"""Files that wandb writes in its offline mode."""

import csv
import hashlib
import json
import os
import signal
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import wandb
from PIL import Image
from wandb.proto.wandb_internal_pb2 import Record

from bgpo_trl.figures.curves import plot_success_curves
from bgpo_trl.figures.frames import save_gif
from bgpo_trl.figures.style import save_figure
from bgpo_trl.runs.logger import RunLogger
from bgpo_trl.training import Trainer

pytestmark = pytest.mark.usefixtures("easy_world")
NOT_IN_THE_CURVE = {"algorithm", "seed", "task", "episode", ""}


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
    """Return the records of each process that worked on the run, first to last."""
    files = directory.glob("wandb/offline-run-*/*.wandb")
    return [records(file) for file in sorted(files, key=lambda file: file.stat().st_mtime_ns)]


def history(session: list[Record]) -> list[dict]:
    return [
        {
            "/".join(item.nested_key) or item.key: json.loads(item.value_json)
            for item in record.history.item
        }
        for record in session
        if record.WhichOneof("record_type") == "history"
    ]


def curve(session: list[Record], group: str) -> list[tuple]:
    """Return the rows of ``train.csv`` or ``eval.csv``, as wandb has them."""
    rows = []
    for row in history(session):
        shown = {key: value for key, value in row.items() if key.startswith(f"{group}/")}
        if shown:
            (prefix,) = {key.rpartition("/")[0] for key in shown}
            values = {key.rpartition("/")[2]: value for key, value in shown.items()}
            rows.append((prefix, values.pop("step"), values))
    return rows


def curve_in_csv(directory: Path, group: str) -> list[tuple]:
    with open(directory / f"{group}.csv", newline="") as file:
        return [
            (
                f"{group}/{row['task']}/seed_{row['seed']}",
                int(row["episode"]),
                {k: float(v) for k, v in row.items() if k not in NOT_IN_THE_CURVE and v},
            )
            for row in csv.DictReader(file)
        ]


def step_metrics(session: list[Record]) -> dict[str, str]:
    """Return the step metric of each curve."""
    metrics = [r.metric for r in session if r.WhichOneof("record_type") == "metric"]
    return {metric.name: metric.step_metric for metric in metrics if metric.step_metric}


@pytest.fixture(scope="module")
def run(easy_world, bank, encoders, make_config, tmp_path_factory):
    """A whole run that was interrupted once, with a figure and a video at its end."""
    directory = tmp_path_factory.mktemp("runs") / "run"

    def trainer():
        parts = {"bank": bank, "encoders": encoders, "progress": False}
        return Trainer(make_config(), directory, resume=True, wandb="offline", **parts)

    with trainer() as interrupted:
        act, steps = interrupted.algorithm.act, []

        def act_or_interrupt(state):
            steps.append(None)
            if len(steps) == 12:
                signal.raise_signal(signal.SIGINT)
            return act(state)

        interrupted.algorithm.act = act_or_interrupt
        with pytest.raises(KeyboardInterrupt):
            interrupted.run()
    with trainer() as resumed:
        resumed.run()
        figures = directory / "figures"
        save_figure(plot_success_curves(directory / "eval.csv"), figures / "success.png")
        frames = np.random.default_rng(0).integers(256, size=(6, 32, 64, 3), dtype=np.uint8)
        save_gif(frames, figures / "grasp_glass.gif")
        for path in sorted(figures.iterdir()):
            resumed.logger.log_media(f"figures/{path.stem}", path)
    return directory


@pytest.mark.parametrize("group", ["train", "eval"])
def test_the_curves_are_those_of_the_csv_files(run, group):
    first, second = (curve(session, group) for session in sessions(run))
    assert len(first) > 0
    assert first + second == curve_in_csv(run, group)


def test_every_curve_is_drawn_over_the_episodes_of_its_seed_and_task(run):
    for session in sessions(run):
        drawn_over = step_metrics(session)
        for group in ("train", "eval"):
            for prefix, _, values in curve(session, group):
                assert {drawn_over[f"{prefix}/{name}"] for name in values} == {f"{prefix}/step"}


def test_both_sessions_belong_to_the_same_run_with_its_settings(run):
    settings = json.loads((run / "config.json").read_text())
    started = [r.run for session in sessions(run) for r in session if r.HasField("run")]
    assert len({record.run_id for record in started}) == 1
    assert [record.resume for record in started] == [True, True]
    for record in started:
        saved = {item.key: json.loads(item.value_json) for item in record.config.update}
        del saved["_wandb"]
        assert saved == settings


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


def test_rows_arrive_in_any_order_and_again_after_a_crash(tmp_path):
    """wandb's own step must never decrease; episodes do, when another seed is ahead."""

    def write(logger, rows):
        for seed, episode in rows:
            row = {"algorithm": "bgpo", "seed": seed, "task": "grasp_glass", "episode": episode}
            logger.log_train({**row, "loss_actor": 1 / (3 * episode + seed)})
            for success in (True, False):
                logger.log_eval({**row, "success": success, "return": float(success)})

    rows = [(0, 7), (1, 2), (0, 8), (1, 3), (0, 9), (1, 1)]
    with RunLogger(tmp_path, config={}, wandb="offline") as logger:
        write(logger, rows[:3])
        position = logger.position()
        write(logger, rows[3:5])  # lost with the crash that follows
    with RunLogger(tmp_path, config={}, wandb="offline", resume=True) as logger:
        logger.truncate_to(position)
        write(logger, rows[3:])
    for group, n in (("train", 1), ("eval", 2)):
        expected = curve_in_csv(tmp_path, group)
        first, second = (curve(session, group) for session in sessions(tmp_path))
        assert first == expected[: 5 * n]
        assert second == expected[3 * n :]


def test_an_unreadable_figure_gives_one_warning_and_the_run_goes_on(tmp_path):
    with RunLogger(tmp_path, config={}, wandb="offline") as logger:
        (tmp_path / "broken.png").write_bytes(b"no picture")
        with pytest.warns(
            UserWarning, match="WandbLogger failed .* is disabled for the rest of this run"
        ):
            logger.log_media("figures/broken", tmp_path / "broken.png")
        logger.log_eval({"algorithm": "bgpo", "seed": 0, "episode": 1, "success": True})
        logger.log_media("figures/broken", tmp_path / "broken.png")
    assert len((tmp_path / "eval.csv").read_text().splitlines()) == 2
