"""Demonstrations written as a LeRobot dataset, and read from one."""

import importlib.util
import io
import json
import shutil
import sys
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

pa = pytest.importorskip("pyarrow")

import pyarrow.parquet as pq  # noqa: E402

from bgpo_trl.data import lerobot_export  # noqa: E402
from bgpo_trl.data.dataset import (  # noqa: E402
    resize_frames,
    write_logged_episodes,
)
from bgpo_trl.data.lerobot import read_lerobot  # noqa: E402
from bgpo_trl.data.lerobot_export import write_lerobot  # noqa: E402
from tests.helpers import POINTER, FilmStandIn, edit, noise_demonstrations  # noqa: E402

TASKS = ("grasp_glass", "push_green_to_white")
STATE = "observation.environment_state"
CAMERA = "observation.images.camera"
DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
LENGTHS = (5, 2, 4)


def dataset_of(keys=("pixels", "action", "state")):
    """Three demonstrations of noise, of the second, first and second task."""
    dataset = noise_demonstrations(LENGTHS).select(*keys, "length")
    return dataset.set("task", torch.tensor([1, 0, 1]))


@pytest.fixture
def written(tmp_path):
    """A LeRobot dataset."""
    write_lerobot(tmp_path / "written", dataset_of(), tasks=TASKS, fps=5, robot_type="nico")
    return tmp_path / "written"


@pytest.mark.parametrize("keys", [("pixels", "action", "state"), ("pixels",)])
def test_what_is_written_is_read_again(tmp_path, keys):
    dataset = dataset_of(keys)
    write_lerobot(tmp_path / "lerobot", dataset, tasks=TASKS, fps=5)

    named = {"state_key": STATE} if "state" in keys else {"action_key": None}
    found = read_lerobot(tmp_path / "lerobot", **named)

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
    monkeypatch.setattr(lerobot_export, "_FILE_BYTES", 1)
    monkeypatch.setattr(lerobot_export, "_FILES_PER_CHUNK", 2)
    path = tmp_path / "many"
    write_lerobot(path, dataset_of(), tasks=TASKS, fps=5)
    rows = pq.read_table(path / EPISODES).to_pylist()
    places = [(row["data/chunk_index"], row["data/file_index"]) for row in rows]
    assert places == [(0, 0), (0, 1), (1, 0)]
    for chunk, file in places:
        assert (path / f"data/chunk-{chunk:03}/file-{file:03}.parquet").is_file()
    assert [len(e["pixels"]) for e in read_lerobot(path)[TASKS[1]]] == [5, 4]


def test_no_demonstrations_and_one_without_a_batch_are_not_written(tmp_path, refused):
    for part, remedy in ((slice(0), "at least 1"), (0, "dataset[:1]")):
        write = partial(write_lerobot, tmp_path / "no", dataset_of()[part], tasks=TASKS, fps=5)
        refused(write, "demonstrations", remedy)
    assert not (tmp_path / "no").exists()


def test_frames_of_another_size_are_resized_if_asked(written):
    found = read_lerobot(written, frame_shape=(16, 32))[TASKS[0]][0]["pixels"]
    np.testing.assert_array_equal(found, resize_frames(dataset_of()["pixels"][1, :2], (16, 32)))


INFO, TASK_FILE = "meta/info.json", "meta/tasks.parquet"
IMAGE = {"dtype": "image", "shape": [32, 64, 3], "names": None}


def edit_rows(path, change, file=DATA):
    rows = pq.read_table(path / file).to_pandas()
    pq.write_table(pa.Table.from_pandas(change(rows)), path / file)


def without(file=DATA, **dropped):
    return lambda path: edit_rows(path, lambda rows: rows.drop(**dropped), file)


def replaced(column, values, file=DATA):
    return lambda path: edit_rows(path, lambda rows: rows.assign(**{column: values}), file)


def edit_info(**changes):
    return lambda path: edit(path / INFO, **changes)


def add_feature(path, name, feature):
    features = json.loads((path / INFO).read_text())["features"]
    edit(path / INFO, features={**features, name: feature})


def saved(image, kind="png"):
    content = io.BytesIO()
    image.save(content, kind)
    return content.getvalue()


@pytest.mark.parametrize(
    ("damage", "cause", "remedy"),
    [
        (without(index=6), "episode 1", "has 1 of 2 frames"),
        (without(index=[5, 6]), "3 by meta/episodes and 2 by data, episodes 1", "get it again"),
        (
            without(EPISODES, index=1),
            "2 by meta/episodes and 3 by data, episodes 1",
            "get it again",
        ),
        (edit_info(total_episodes=4), "has 4 episodes by meta/info.json, 3 by", "get it again"),
        (edit_info(total_frames=12), "12 frames by meta/info.json, 11 by meta", "get it again"),
        (
            replaced("timestamp", [0, 0.2, 0.6, 0.8, 1, 0, 0.2, 0, 0.2, 0.4, 0.6]),
            "frame 2 is at 0.600 s instead of 0.400 s",
            "evenly",
        ),
        (
            lambda p: (p / INFO).write_bytes(POINTER),
            "info.json is a pointer of Git LFS",
            "git lfs pull",
        ),
        (
            lambda p: pq.write_table(pa.table({"task_index": [0, 1]}), p / TASK_FILE),
            "its tasks are 0, 1, not descriptions",
            "tasks.parquet",
        ),
        (replaced("task_index", range(11)), "has the tasks [0, 1, 2, 3, 4]", "one task"),
        (
            replaced("task_index", [[0, 1]] * 11),
            "data: task_index has [0, 1] in a row",
            "one number",
        ),
        (
            replaced("length", [[5], [], [4]], EPISODES),
            "meta/episodes: length has [] in a row",
            "one number",
        ),
        (without(columns="frame_index"), "damaged or of another format", "frame_index"),
        (replaced(CAMERA, [{"bytes": b"PNG"}] * 11), "episode 0", "is damaged"),
        (lambda p: (p / INFO).write_text("[]"), "info.json", "is damaged"),
        (lambda p: (p / INFO).unlink(), "info.json", "give the folder of a whole"),
        (lambda p: shutil.rmtree(p / "data"), "data is missing", "give the folder of a whole"),
        (lambda p: (p / "meta/tasks.parquet").write_bytes(b"PAR1"), "tasks.parquet", "damaged"),
        (edit_info(codebase_version="v2.1"), "version v2.1, not 3", "convert it"),
        (edit_info(features={}), "has no camera of colors, only nothing", "record some"),
        (
            edit_info(features={"a": IMAGE, "b": IMAGE}),
            "has several cameras",
            "one of a, b as image_key",
        ),
    ],
)
def test_incomplete_and_damaged_datasets_are_refused(written, refused, damage, cause, remedy):
    damage(written)
    refused(lambda: read_lerobot(written), cause, remedy)


def test_unknown_features_are_refused(written, refused, monkeypatch):
    for wrong, cause in (
        ({"image_key": "wrist"}, f"has no camera called 'wrist': give one of {CAMERA} as"),
        ({"state_key": "joints"}, "no numbers 'joints': give the states' feature as state_key"),
        ({"action_key": "actoin"}, "no numbers 'actoin': give the actions' feature as action_key"),
        ({"action_key": CAMERA}, f"no numbers '{CAMERA}'"),
        ({"episodes": np.array([1, 3])}, "no episode 3: choose among 0, 1, 2"),
        ({"tasks": ["wipe"]}, "no task 'wipe': choose among grasp_glass"),
        ({"stride": 2}, "say how actions become one"),
        ({"stride": 0}, "stride 0"),
        ({"success_key": "next.sucess"}, "no 'next.sucess', by which .*: give one of its features"),
        ({"logged": True}, "no 'next.success', .*success_key"),
    ):
        with pytest.raises(ValueError, match=cause):
            read_lerobot(written, **wrong)
    found = read_lerobot(written, action_key=None)
    assert {*found[TASKS[0]][0]} == {"pixels"}
    edit_info(features={"camera": {**IMAGE, "dtype": "video"}})(written)
    monkeypatch.setitem(sys.modules, "av", None)
    refused(lambda: read_lerobot(written), "has its frames as video", "pip install av")


def test_failed_episodes_are_no_demonstrations_unless_asked_for(written, refused):
    add_feature(written, "next.success", {"dtype": "bool", "shape": [1], "names": None})
    outcomes = [False] * 4 + [True] + [False] * 6  # of the first episode alone
    replaced("next.success", outcomes)(written)
    refused(lambda: read_lerobot(written), "failed, without 'next.success': 1, 2", "episodes=...")
    assert [len(some) for some in read_lerobot(written, episodes=[0]).values()] == [0, 1]
    assert [len(some) for some in read_lerobot(written, success_key=None).values()] == [1, 2]
    logged = read_lerobot(written, logged=True)
    found = [[one["success"] for one in logged[task]] for task in TASKS]
    assert found == [[False], [True, False]]
    write_logged_episodes(written.parent / "log", logged, scene="nico")


def test_a_success_of_another_name_is_asked_for(written, refused):
    """The failed episode was a demonstration."""
    add_feature(written, "success", {"dtype": "int64", "shape": [1]})
    replaced("success", [0] * 5 + [1] * 6)(written)
    refused(lambda: read_lerobot(written), "no 'next.success'", "success_key, success, or None")
    with pytest.raises(ValueError, match="failed, without 'success': 0;"):
        read_lerobot(written, success_key="success")
    assert [len(some) for some in read_lerobot(written, success_key=None).values()] == [1, 2]


@pytest.mark.parametrize("value", [np.nan, -0.5, 2])
def test_numbers_that_are_no_success_are_refused(written, refused, value):
    """A reward, or NaN, is true to Python."""
    add_feature(written, "next.success", {"dtype": "float32", "shape": [1]})
    replaced("next.success", [0.0, value] + [1.0] * 9)(written)
    for logged in (False, True):
        call = partial(read_lerobot, written, logged=logged)
        refused(call, f"has the success {float(value)}, which is neither", "success_key")


def test_some_episodes_tasks_and_frames_are_read(written):
    dataset, first = dataset_of(), slice(0, 5, 2)
    found = read_lerobot(written, tasks=TASKS[1:], stride=2, combine=lambda a: a.sum(0))
    assert [*found] == [TASKS[1]]
    one, two = found[TASKS[1]]
    np.testing.assert_array_equal(one["pixels"], dataset["pixels"][0, first])
    summed = dataset["action"][0].unflatten(0, (2, 2)).sum(1)  # frames 0 to 2 and 2 to 4
    np.testing.assert_array_equal(one["action"], summed)
    # Of frames 0 to 3: the last one shows the success.
    np.testing.assert_array_equal(two["pixels"], dataset["pixels"][2, 1:4:2])
    np.testing.assert_array_equal(two["action"], dataset["action"][2, 1:3].sum(0, keepdim=True))
    last = read_lerobot(written, episodes=[0], stride=2, combine=lambda a: a[-1])[TASKS[1]][0]
    np.testing.assert_array_equal(last["action"], dataset["action"][0, 1::2])


def test_tasks_and_numbers_may_be_stored_as_other_libraries_do(written):
    expected = read_lerobot(written)
    tasks = pa.table({"task": [*TASKS], "task_index": [0, 1]})  # without an index of pandas
    pq.write_table(tasks, written / TASK_FILE)
    edit_rows(written, lambda rows: rows.assign(task_index=[[i] for i in rows["task_index"]]))
    replaced("length", [[n] for n in LENGTHS], EPISODES)(written)
    found = read_lerobot(written, episodes=np.arange(3))
    assert [*found] == [*TASKS]
    for name in TASKS:
        for one, other in zip(found[name], expected[name], strict=True):
            np.testing.assert_array_equal(one["pixels"], other["pixels"])


def test_images_may_lie_in_files_of_the_dataset_alone(written):
    expected = read_lerobot(written)[TASKS[0]][0]["pixels"]
    rows = pq.read_table(written / DATA).to_pandas()
    (written / "images").mkdir()
    for number, image in enumerate(rows[CAMERA]):
        (written / "images" / f"{number}.png").write_bytes(image["bytes"])
    beside = [{"bytes": None, "path": f"images/{number}.png"} for number in range(11)]
    replaced(CAMERA, beside)(written)
    np.testing.assert_array_equal(read_lerobot(written)[TASKS[0]][0]["pixels"], expected)
    (written / "images" / "6.png").write_bytes(POINTER)
    with pytest.raises(ValueError, match=r"episode 1 of .*6.png is a pointer of Git LFS: get"):
        read_lerobot(written)
    (written.parent / "secret.png").write_bytes(rows[CAMERA][0]["bytes"])
    replaced(CAMERA, [{"bytes": None, "path": "../secret.png"}] * 11)(written)
    with pytest.raises(ValueError, match=r"episode 0 of .*'../secret.png' is no file of the data"):
        read_lerobot(written)


SIZE = (64, 32)
COLOR = (10, 20, 30)


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (saved(Image.new("I;16", SIZE, 3_000)), "of mode I;16, of more than 8 bits"),
        (saved(Image.new("I", SIZE, 3_000), "tiff"), "of mode I, of more than 8 bits"),
        (saved(Image.new("F", SIZE, 0.5), "tiff"), "of mode F, of more than 8 bits"),
        (saved(Image.new("RGBA", SIZE, (*COLOR, 128))), "its images are transparent"),
    ],
)
def test_images_that_would_have_to_be_converted_are_refused(written, refused, content, cause):
    """They were black or white: Pillow cuts what exceeds 255."""
    replaced(CAMERA, [{"bytes": content}] * 11)(written)
    refused(lambda: read_lerobot(written), "episode 0", cause)


def test_gray_opaque_and_palette_images_are_exact(written):
    plain, gray = Image.new("RGB", SIZE, COLOR), Image.new("L", SIZE, 7)
    for image, color in ((gray, 7), (plain.convert("RGBA"), COLOR), (plain.quantize(), COLOR)):
        replaced(CAMERA, [{"bytes": saved(image)}] * 11)(written)
        assert (read_lerobot(written)[TASKS[0]][0]["pixels"] == color).all()


def test_depth_maps_are_no_cameras(written):
    add_feature(written, "depth", {**IMAGE, "info": {"is_depth_map": True}})
    assert {*read_lerobot(written)} == {*TASKS}  # the other camera is the only one
    with pytest.raises(ValueError, match=f"has a depth map 'depth'.*{CAMERA}"):
        read_lerobot(written, image_key="depth")


def test_invalid_arguments_are_refused_before_anything_is_written(tmp_path, refused):
    dataset = dataset_of()
    for shown, options in (
        (dataset, {"fps": 0}),
        (dataset, {"tasks": TASKS[:1]}),
        (dataset, {"tasks": TASKS[:1] * 2}),
        (dataset[:0], {}),
    ):
        given = {"tasks": TASKS, "fps": 5, **options}
        refused(partial(write_lerobot, tmp_path / "new", shown, **given), "", "")


GRAYS = np.arange(12) * 20 + 20


def encode(file, kept, pix_fmt, codec):
    """Write a film of gray frames with PyAV."""
    av = importlib.import_module("av")
    with av.open(str(file), "w") as video:
        stream = video.add_stream(codec, rate=5)
        (stream.width, stream.height), stream.pix_fmt = (64, 32), pix_fmt
        stream.bit_rate = 8_000_000
        for number in kept:
            frame = np.full((32, 64, 3), GRAYS[number], np.uint8)
            frame = av.VideoFrame.from_ndarray(frame, format="rgb24")
            frame.pts = number
            video.mux(stream.encode(frame))
        video.mux(stream.encode())


@pytest.fixture
def film(written, monkeypatch):
    """Turns the images of a dataset into a film, in which the first episode ends at 1 s."""

    def make(kept=range(11), pix_fmt="yuv420p", codec="mpeg4"):
        file = written / f"videos/{CAMERA}/chunk-000/file-000.mp4"
        file.parent.mkdir(parents=True)
        if importlib.util.find_spec("av"):
            encode(file, kept, pix_fmt, codec)
        else:
            file.touch()
            shown = {number: np.full((32, 64, 3), GRAYS[number], np.uint8) for number in kept}
            monkeypatch.setitem(sys.modules, "av", FilmStandIn(shown, 5, pix_fmt))
        without(columns=CAMERA)(written)
        places = {"chunk_index": 0, "file_index": 0, "from_timestamp": (0.0, 1.0, 1.4)}
        places = {f"videos/{CAMERA}/{key}": value for key, value in places.items()}
        edit_rows(written, lambda rows: rows.assign(**places), EPISODES)
        add_feature(written, CAMERA, {**IMAGE, "dtype": "video"})
        return file

    return make


def test_frames_of_a_video_are_decoded_from_the_first_of_the_episode(written, film):
    path = film()

    found = read_lerobot(written)

    read = [found[TASKS[1]][0], found[TASKS[0]][0], found[TASKS[1]][1]]
    shown = np.concatenate([episode["pixels"].mean((1, 2, 3)) for episode in read])
    np.testing.assert_allclose(shown, GRAYS[:11], atol=6)
    every_other = read_lerobot(written, stride=2, combine=lambda a: a[0])[TASKS[1]][0]["pixels"]
    np.testing.assert_allclose(every_other.mean((1, 2, 3)), GRAYS[:5:2], atol=6)
    path.unlink()
    with pytest.raises(ValueError, match=r"episode 0 of .*file-000.mp4 is missing: give the"):
        read_lerobot(written)


def test_episodes_of_other_sizes_are_not_squeezed_into_one(written, refused):
    sizes = [(8, 8)] * 5 + [(8, 4)] * 6
    images = [{"bytes": saved(Image.new("RGB", size))} for size in sizes]
    replaced(CAMERA, images)(written)
    cause = "differ in size, [8, 8, 3] and [4, 8, 3]"
    refused(lambda: read_lerobot(written, frame_shape=(8, 8)), cause, "make them alike")


def test_a_damaged_video_is_refused(written, film, refused):
    path = film()
    if isinstance(stand_in := sys.modules["av"], FilmStandIn):
        stand_in.corrupt = 2
    else:
        content = bytearray(path.read_bytes())
        data = content.index(b"mdat") + 4
        content[data + 200 : data + 216] = b"\x55" * 16
        path.write_bytes(content)
    refused(lambda: read_lerobot(written), "episode 0 of ", "damaged")


@pytest.mark.parametrize(
    ("gap", "episode", "cause"),
    [
        (2, 0, "there is no frame at 0.400 s"),
        (5, 1, "there is no frame at 1.000 s"),
        (10, 0, "it ends at 2.000 s, its last episode at 2.200 s"),
    ],
)
def test_a_video_that_lacks_a_frame_is_refused(written, film, refused, gap, episode, cause):
    """Read one after the other, all later frames would be off by one against the actions."""
    film([number for number in range(11) if number != gap])
    refused(lambda: read_lerobot(written), f"episode {episode} of ", cause)


@pytest.mark.parametrize(
    ("starts", "cause"),
    [
        ((0.0, 1.0, 1.4), "episode 2 of .* ends at 2.200 s of its film .* the film at 2.400 s"),
        ((0.0, 1.2, 1.6), "episode 0 of .* ends at 1.000 s .* the next one begins at 1.200 s"),
    ],
)
def test_a_video_with_a_frame_too_many_is_told_once(written, film, starts, cause):
    film(range(12))
    replaced(f"videos/{CAMERA}/from_timestamp", starts, EPISODES)(written)
    with pytest.warns(UserWarning, match=cause) as caught:
        read_lerobot(written)
    assert len(caught) == 1


def test_a_video_may_show_episodes_that_were_removed(written, film, recwarn):
    film()
    without(index=[5, 6])(written)
    without(EPISODES, index=1)(written)
    edit_info(total_episodes=2, total_frames=9)(written)
    assert [len(e["pixels"]) for e in read_lerobot(written)[TASKS[1]]] == [5, 4]
    assert not recwarn.list


def test_episodes_that_overlap_in_a_video_are_refused(written, film, refused):
    film()
    replaced(f"videos/{CAMERA}/from_timestamp", (0.0, 0.8, 1.4), EPISODES)(written)
    cause = "begins in another one's frames, at 0.800 s"
    refused(lambda: read_lerobot(written, episodes=[0]), cause, "get it again")


def test_a_video_of_more_than_eight_bits_a_color_is_refused(written, film):
    film(pix_fmt="yuv420p10le", codec="ffv1")
    with pytest.raises(ValueError, match="its frames are yuv420p10le, of more than 8 bits"):
        read_lerobot(written)
