"""Demonstrations written as a LeRobot dataset, and read from one."""

import json
import shutil
import sys

import numpy as np
import pandas as pd
import pytest
import torch
from tensordict import TensorDict

pa = pytest.importorskip("pyarrow")

import pyarrow.parquet as pq  # noqa: E402

from bgpo_trl.data import lerobot  # noqa: E402
from bgpo_trl.data.dataset import resize_frames, write_demonstrations  # noqa: E402
from bgpo_trl.data.lerobot import read_lerobot, write_lerobot  # noqa: E402
from tests.helpers import edit  # noqa: E402

TASKS = ("grasp_glass", "push_green_to_white")
STATE = "observation.environment_state"
CAMERA = "observation.images.camera"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
LENGTHS = (5, 2, 4)


def dataset_of(keys=("pixels", "action", "state")):
    """Three demonstrations of noise, of the second, first and second task."""
    generator = torch.Generator().manual_seed(0)
    length = torch.tensor(LENGTHS)
    steps = torch.arange(5) < length.unsqueeze(-1)
    pixels = torch.randint(256, (3, 5, 32, 64, 3), generator=generator, dtype=torch.uint8)
    entries = {
        "pixels": pixels * steps[:, :, None, None, None],
        "action": (torch.rand(3, 4, 4, generator=generator) * 2 - 1) * steps[:, 1:, None],
        "state": torch.randn(3, 5, 16, generator=generator) * steps[:, :, None],
    }
    chosen = {key: entries[key] for key in keys}
    return TensorDict({**chosen, "length": length, "task": torch.tensor([1, 0, 1])}, [3])


@pytest.fixture
def written(tmp_path):
    """A LeRobot dataset."""
    write_lerobot(tmp_path / "written", dataset_of(), tasks=TASKS, fps=5, robot_type="nico")
    return tmp_path / "written"


@pytest.mark.parametrize("keys", [("pixels", "action", "state"), ("pixels",)])
def test_what_is_written_is_read_again(tmp_path, keys):
    dataset = dataset_of(keys)
    write_lerobot(tmp_path / "lerobot", dataset, tasks=TASKS, fps=5)

    found = read_lerobot(tmp_path / "lerobot", state_key=STATE if "state" in keys else None)

    assert [*found] == [*TASKS]
    for (task, number), row in zip([(1, 0), (0, 0), (1, 1)], dataset, strict=True):
        episode, length = found[TASKS[task]][number], int(row["length"])
        assert {*episode} == {*keys}
        for key, values in episode.items():
            expected = row[key][: length - (key == "action")].numpy()
            assert values.dtype == expected.dtype
            np.testing.assert_array_equal(values, expected)


def test_the_files_are_those_of_version_3_of_the_format(written):
    dataset = dataset_of()
    info = json.loads((written / "meta" / "info.json").read_text())
    totals = {"total_episodes": 3, "total_frames": 11, "total_tasks": 2, "fps": 5}
    assert info.items() >= {"codebase_version": "v3.0", **totals}.items()
    camera = info["features"][CAMERA]
    assert (camera["dtype"], camera["shape"]) == ("image", [32, 64, 3])
    assert info["features"]["action"]["shape"] == [4]

    tasks = pd.read_parquet(written / "meta" / "tasks.parquet")
    assert tasks["task_index"].to_dict() == {"grasp_glass": 0, "push_green_to_white": 1}

    episodes = pq.read_table(written / EPISODES).to_pylist()
    assert [row["length"] for row in episodes] == [*LENGTHS]
    assert [row["tasks"] for row in episodes] == [[TASKS[1]], [TASKS[0]], [TASKS[1]]]
    bounds = [(row["dataset_from_index"], row["dataset_to_index"]) for row in episodes]
    assert bounds == [(0, 5), (5, 7), (7, 11)]

    table = pq.read_table(written / info["data_path"].format(chunk_index=0, file_index=0))
    assert {*table.column_names} == {*info["features"]}
    rows = table.to_pandas()
    assert rows["index"].tolist() == [*range(11)]
    assert rows["frame_index"].tolist() == [0, 1, 2, 3, 4, 0, 1, 0, 1, 2, 3]
    assert rows["episode_index"].tolist() == [0] * 5 + [1] * 2 + [2] * 4
    assert rows["task_index"].tolist() == [1] * 5 + [0] * 2 + [1] * 4
    np.testing.assert_allclose(rows["timestamp"][:5], [0, 0.2, 0.4, 0.6, 0.8], rtol=1e-6)
    action = np.stack([*rows["action"]])
    np.testing.assert_array_equal(action[:5], [*dataset["action"][0].tolist(), [0] * 4])


def test_statistics_are_those_of_all_frames(written):
    dataset = dataset_of()
    stats = json.loads((written / "meta" / "stats.json").read_text())
    frames = torch.cat([dataset["pixels"][i, :n] for i, n in enumerate(LENGTHS)]).numpy() / 255
    states = torch.cat([dataset["state"][i, :n] for i, n in enumerate(LENGTHS)]).numpy()
    for name in ("min", "max", "mean", "std"):
        found, expected = np.array(stats[CAMERA][name]), getattr(frames, name)((0, 1, 2))
        np.testing.assert_allclose(found, expected.reshape(3, 1, 1), rtol=1e-6)
        np.testing.assert_allclose(stats[STATE][name], getattr(states, name)(0), rtol=1e-5)
    assert stats[STATE]["count"] == [11]


def test_long_datasets_are_spread_over_several_files(tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot, "_FILE_MB", 0)
    monkeypatch.setattr(lerobot, "_FILES_PER_CHUNK", 2)
    path = tmp_path / "many"
    write_lerobot(path, dataset_of(), tasks=TASKS, fps=5)
    rows = pq.read_table(path / EPISODES).to_pylist()
    places = [(row["data/chunk_index"], row["data/file_index"]) for row in rows]
    assert places == [(0, 0), (0, 1), (1, 0)]
    for chunk, file in places:
        assert (path / f"data/chunk-{chunk:03}/file-{file:03}.parquet").is_file()
    assert [len(e["pixels"]) for e in read_lerobot(path)[TASKS[1]]] == [5, 4]


def test_frames_of_another_size_are_resized_if_asked(written, tmp_path):
    found = read_lerobot(written, frame_shape=(16, 32))[TASKS[0]][0]["pixels"]
    np.testing.assert_array_equal(found, resize_frames(dataset_of()["pixels"][1, :2], (16, 32)))
    with pytest.raises(ValueError, match=r"frames of 16 x 32 pixels.*resize"):
        small = {TASKS[0]: [{"pixels": found}] * 2}
        write_demonstrations(tmp_path / "own", small, scene="nico", held_out_per_task=1)


def edit_rows(path, change, file="data/chunk-000/file-000.parquet"):
    rows = pq.read_table(path / file).to_pandas()
    pq.write_table(pa.Table.from_pandas(change(rows)), path / file)


def without(row):
    return lambda path: edit_rows(path, lambda rows: rows.drop(index=row))


def edit_info(**changes):
    return lambda path: edit(path / INFO, **changes)


def replaced(column, values):
    return lambda path: edit_rows(path, lambda rows: rows.assign(**{column: values}))


INFO = "meta/info.json"
IMAGE = {"dtype": "image", "shape": [32, 64, 3], "names": None}


@pytest.mark.parametrize(
    ("damage", "cause", "remedy"),
    [
        (without(6), "episode 1", "has 1 of 2 frames"),
        (without([5, 6]), "episode 1", "has 0 of 2 frames"),
        (replaced("task_index", range(11)), "has the tasks [0, 1, 2, 3, 4]", "one task"),
        (
            lambda p: edit_rows(p, lambda rows: rows.drop(columns="frame_index")),
            "file-000.parquet is damaged or of another format",
            "frame_index",
        ),
        (replaced(CAMERA, [{"bytes": b"PNG"}] * 11), "episode 0", "is damaged"),
        (lambda p: (p / INFO).write_text("[]"), "info.json", "is damaged"),
        (lambda p: (p / INFO).unlink(), "info.json", "give the folder of a whole"),
        (lambda p: shutil.rmtree(p / "data"), "data is missing", "give the folder of a whole"),
        (lambda p: (p / "meta/tasks.parquet").write_bytes(b"PAR1"), "tasks.parquet", "damaged"),
        (edit_info(codebase_version="v2.1"), "version v2.1, not 3", "convert it"),
        (edit_info(features={}), "cameras none", "image_key"),
        (edit_info(features={"a": IMAGE, "b": IMAGE}), "cameras a, b", "image_key"),
    ],
)
def test_incomplete_and_damaged_datasets_are_refused(written, refused, damage, cause, remedy):
    damage(written)
    refused(lambda: read_lerobot(written), cause, remedy)


def test_unknown_features_are_refused(written, refused, monkeypatch):
    refused(lambda: read_lerobot(written, image_key="wrist"), "cameras", "image_key")
    refused(lambda: read_lerobot(written, state_key="joints"), "no 'joints'", STATE)
    found = read_lerobot(written, action_key=None)
    assert {*found[TASKS[0]][0]} == {"pixels"}
    edit_info(features={"camera": {**IMAGE, "dtype": "video"}})(written)
    monkeypatch.setitem(sys.modules, "av", None)
    refused(lambda: read_lerobot(written), "has its frames as video", "pip install av")


def test_invalid_arguments_are_refused_before_anything_is_written(tmp_path):
    dataset = dataset_of()
    for shown, options in (
        (dataset, {"fps": 0}),
        (dataset, {"tasks": TASKS[:1]}),
        (dataset, {"tasks": TASKS[:1] * 2}),
        (dataset[:0], {}),
    ):
        with pytest.raises(ValueError):
            write_lerobot(tmp_path / "new", shown, **({"tasks": TASKS, "fps": 5} | options))
    assert not [*tmp_path.iterdir()]


def test_frames_of_a_video_are_decoded_from_the_first_of_the_episode(written):
    av = pytest.importorskip("av")
    grays = np.arange(11) * 20 + 20
    path = written / f"videos/{CAMERA}/chunk-000/file-000.mp4"
    path.parent.mkdir(parents=True)
    with av.open(str(path), "w") as video:
        stream = video.add_stream("mpeg4", rate=5)
        stream.width, stream.height, stream.pix_fmt = 64, 32, "yuv420p"
        stream.bit_rate = 8_000_000
        for gray in grays:
            frame = np.full((32, 64, 3), gray, np.uint8)
            video.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        video.mux(stream.encode())
    edit_rows(written, lambda rows: rows.drop(columns=CAMERA))
    places = {"chunk_index": 0, "file_index": 0, "from_timestamp": (0.0, 1.0, 1.4)}
    places = {f"videos/{CAMERA}/{key}": value for key, value in places.items()}
    edit_rows(written, lambda rows: rows.assign(**places), EPISODES)
    features = json.loads((written / INFO).read_text())["features"]
    edit_info(features={**features, CAMERA: {**IMAGE, "dtype": "video"}})(written)

    found = read_lerobot(written)

    read = [found[TASKS[1]][0], found[TASKS[0]][0], found[TASKS[1]][1]]
    shown = np.concatenate([episode["pixels"].mean((1, 2, 3)) for episode in read])
    np.testing.assert_allclose(shown, grays, atol=6)
    path.unlink()
    with pytest.raises(ValueError, match=r"episode 0 of .* is "):
        read_lerobot(written)
