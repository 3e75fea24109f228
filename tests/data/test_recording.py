import re

import pytest
import torch

from bgpo_trl.data import recording as demonstrations
from bgpo_trl.data.dataset import META, load_demonstrations, open_dataset, read_meta
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.experiments.arguments import (
    EncodersArguments,
    MakeBankArguments,
    ProbesArguments,
    RecordArguments,
)
from bgpo_trl.experiments.make_data import bank, encoders, probes, record
from suites import nico
from tests.helpers import contents
from tests.scenes.dot import Dot, demonstrate, record_some, scene

TINY = {"per_task": 3, "held_out_per_task": 1, "progress": False}
KEYS = {"pixels", "state", "joints", "action", "length", "task", "train", "seed"}


def test_recording_returns_what_loading_does(recorded):
    dataset = load_demonstrations(recorded)

    assert set(dataset.keys()) == KEYS
    shapes = {"pixels": (51, 32, 64, 3), "state": (51, 16), "joints": (51, 4), "action": (50, 4)}
    for key in KEYS:
        assert dataset[key].shape == (9, *shapes.get(key, ()))
    assert dataset["pixels"].dtype == torch.uint8
    assert dataset["length"].dtype == dataset["task"].dtype == torch.int64
    assert dataset["task"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert dataset["train"].tolist() == [True, True, False] * 3
    assert dataset["seed"].tolist() == [0] * 9
    assert len(dataset["state"][:, 0].unique(dim=0)) == 9
    assert dataset["joints"].equal(dataset["state"][..., :4])
    again = record_demonstrations(recorded, **TINY)  # complete: only opened
    for key in KEYS:
        torch.testing.assert_close(again[key], dataset[key], rtol=0, atol=0)


def test_padding_is_zero_and_the_rest_is_not(recorded):
    for row in load_demonstrations(recorded):
        length = int(row["length"])
        assert 10 < length <= 51
        assert (row["pixels"][:length].float().std(dim=(1, 2, 3)) > 10).all()
        assert row["state"][:length].abs().sum(-1).min() > 0
        assert row["action"][: length - 1].abs().sum(-1).min() > 0
        assert row["action"].abs().max() <= 1
        assert not row["pixels"][length:].any()
        assert not row["state"][length:].any()
        assert not row["action"][length - 1 :].any()


def test_play_follows_a_demonstration_and_then_moves_at_random(tmp_path):
    options = {"per_task": 6, "held_out_per_task": 1, "progress": False}
    play = record_demonstrations(tmp_path / "play", play=True, **options)

    whole = play["length"] == 51
    assert whole.float().mean() > 0.5  # the rest have come far enough to succeed
    assert len(play["state"][:, 0].unique(dim=0)) == 18
    action = play["action"][whole]
    early, late = action[:, :2].std(), action[:, -15:].std()
    assert late > 0.25  # a demonstrator moves by less
    assert early < late
    reach = play["state"][whole][:, :, 4:7]
    assert (reach[:, -1] - reach[:, 0]).norm(dim=-1).mean() > 0.1
    # Nothing of it passes as demonstrations, and the other way round.
    for wrong in (False, True):
        with pytest.raises(ValueError, match="holds another recording"):
            record_demonstrations(
                tmp_path / "play", play=wrong, **(options | {"per_task": 6 + wrong})
            )
    again = record_demonstrations(tmp_path / "again", play=True, **options)
    for key in KEYS:
        assert again[key].equal(play[key])


def test_a_demonstrator_that_never_succeeds_is_told_of(tmp_path, monkeypatch):
    """Here from the third attempt on."""
    able = {"left": 99, "right": 2}

    def tiring(simulation, task, seed):
        act, able[task] = demonstrate(simulation, task, seed), able[task] - 1
        return act if able[task] >= 0 else lambda: 0 * act()

    monkeypatch.setattr(demonstrations, "check_scene", lambda *_: [])  # its attempts are counted
    with pytest.raises(RuntimeError) as raised:
        record_some(tmp_path, scene(demonstrator=tiring), per_task=4, attempts=3)
    assert str(raised.value) == (
        "the demonstrator of 'right' failed 3 times in a row (2 of 5 attempts succeeded, 40%): fix "
        "it, or raise the attempts of record_demonstrations"
    )
    before = open_dataset(tmp_path, read_meta(tmp_path))["length"].clone()
    assert (before > 0).tolist() == [True] * 6 + [False] * 2
    mended = record_some(tmp_path, scene(), per_task=4)
    assert (mended["length"] > 0).all()
    assert mended["length"][:6].equal(before[:6])


def test_a_demonstrator_that_seldom_succeeds_is_told_of(tmp_path):
    def seldom(simulation, task, seed):
        act = demonstrate(simulation, task, seed)
        return act if seed % 8 == 0 or task == "right" else lambda: 0 * act()

    with pytest.warns(UserWarning) as warned:
        record_some(tmp_path, scene(demonstrator=seldom), per_task=6)
    (told,) = [str(line.message) for line in warned]
    assert re.match(r"the demonstrator of 'left' succeeded in 6 of \d\d attempts: ", told)


def test_an_interrupted_recording_ends_as_an_uninterrupted_one(recorded, tmp_path, monkeypatch):
    record = demonstrations._Recorder.demonstrate
    rows = []

    def interrupted(recorder, task, row):
        rows.append(row)
        if len(rows) == 5:
            raise KeyboardInterrupt
        return record(recorder, task, row)

    monkeypatch.setattr(demonstrations._Recorder, "demonstrate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        record_demonstrations(tmp_path, **TINY)
    with pytest.raises(ValueError, match=r"is not complete; resume it with the same command$"):
        load_demonstrations(tmp_path)
    record_demonstrations(tmp_path, **TINY)

    assert rows == [0, 1, 2, 3, 4, 4, 5, 6, 7, 8]  # none twice but the one it was at
    assert contents(tmp_path) == contents(recorded)


def test_rows_of_a_recording_without_settings_are_not_taken_for_new_ones(copy):
    (copy / META).unlink()
    with pytest.raises(ValueError, match=f"rows of a recording without {META}: remove it"):
        record_demonstrations(copy, **TINY)


def test_the_environment_is_closed_if_a_recording_fails(tmp_path):
    closed = []

    class Watched(Dot):
        def close(self):
            closed.append(self)

    def broken(simulation, task, seed):
        raise RuntimeError("no power")

    with pytest.raises(RuntimeError, match="no power"):
        record_some(tmp_path, scene(Watched, demonstrator=broken))
    assert len(closed) == 3  # two of check_scene


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"held_out_per_task": 3}, "held_out_per_task is 3: it must be less than per_task, 3"),
        ({"per_task": 0}, "held_out_per_task is 1: it must be less than per_task, 0"),
        ({"seed": -1}, "seed must lie in 0..2"),
        ({"seed": 2**63}, "seed must lie in 0..2"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_written(tmp_path, refused, wrong, message):
    refused(lambda: record_demonstrations(tmp_path / "new", **{**TINY, **wrong}), message, "")


def test_the_command_records_all_tasks_by_one_word_and_says_what_it_made(tmp_path):
    said = record(RecordArguments(path=tmp_path, tasks=("all",), per_task=1, held_out_per_task=0))

    assert read_meta(tmp_path)["tasks"] == list(nico.ALL_TASKS)
    assert said == f"8 demonstrations, 0 of them held out: {tmp_path}"


def test_play_is_not_taken_for_demonstrations(tmp_path, refused):
    play = tmp_path / "play"
    record_demonstrations(play, tasks=["press_white"], play=True, **TINY)
    for call in (
        lambda: bank(MakeBankArguments(dataset=play, out=tmp_path / "bank")),
        lambda: encoders(EncodersArguments(dataset=play, play=play)),
        lambda: probes(ProbesArguments(dataset=play, out=tmp_path / "probes")),
    ):
        refused(call, f"{play} holds play, which is no demonstration", "first, that of play second")
    assert [*tmp_path.iterdir()] == [play]
