"""A run's directory: one process at a time, complete, and of the same run; else nothing changes."""

import json
import shutil
from dataclasses import asdict, replace
from functools import partial

import pytest

from bgpo_trl.files.checkpoint import load_checkpoint, save_checkpoint
from bgpo_trl.runs.directory import open_tables
from bgpo_trl.scenes import SCENES, find_scene
from tests.helpers import CHECKPOINTS, UNPICKLED, edit, interrupt, put_checkpoint

pytestmark = pytest.mark.usefixtures("easy_world")


@pytest.fixture(scope="module")
def interrupted(easy_world, begin, tmp_path_factory):
    """A run that was interrupted half-way, with rows after its last checkpoint."""
    directory = tmp_path_factory.mktemp("interrupted") / "run"
    interrupt(begin(directory), 25)
    for name in ("train.csv", "eval.csv"):
        with (directory / name).open("a") as file:
            file.write("bgpo,3,9,9,grasp_glass,1,1.0,5\n" * 2)
    return directory


@pytest.fixture
def run(interrupted, tmp_path):
    return shutil.copytree(interrupted, tmp_path / "run")


def test_one_process_at_a_time_uses_a_run_directory(run, begin, other_process, refused):
    other = other_process(run)
    assert other.stdout.readline() == "has it\n"
    for resume in (False, True):
        refused(lambda resume=resume: begin(run, resume=resume), f"{run} is in use", "stop it")


def cut(run):
    (run / "eval.csv").write_bytes((run / "eval.csv").read_bytes()[:-200])


DAMAGES = [
    (lambda run: shutil.rmtree(run / "checkpoint"), "has rows of a run, but no checkpoint"),
    (lambda run: (run / "train.csv").unlink(), "train.csv lacks rows from before the checkpoint"),
    (cut, "eval.csv lacks rows from before the checkpoint"),
]


@pytest.mark.parametrize(("damage", "cause"), DAMAGES)
def test_a_run_that_lacks_a_file_is_refused_unchanged(run, begin, refused, damage, cause):
    damage(run)
    refused(lambda: begin(run, resume=True), cause, "as the run left it")
    refused(lambda: begin(run), "already holds a run", "choose another run directory")


def test_a_run_is_resumed_in_the_version_of_its_scene_alone(
    begin, make_config, tmp_path, refused, monkeypatch
):
    """Nothing else would tell: no encoders, and demonstrations of any scene."""
    run = tmp_path / "run"
    resume = partial(begin, run, make_config("state", "ddpg"), encoders=None, resume=True)
    interrupt(resume(), 5)
    found = find_scene("nico")
    assert json.loads((run / "config.json").read_text())["scene_version"] == found.version
    for changed in (replace(found, version="2"), replace(found, setup={"camera": "left"})):
        with monkeypatch.context() as patch:
            patch.setitem(SCENES, "nico", changed)
            cause = f"scene_version is {found.version} there and {changed.full_version} here"
            refused(resume, cause, "the version of the run")
    resume().close()


def test_a_run_is_not_resumed_from_a_checkpoint_of_something_else(run, begin, refused):
    resume = partial(begin, run, resume=True)
    state = load_checkpoint(run / "checkpoint")
    for name in ("world", "algorithm", "evaluator"):
        save_checkpoint(run / "checkpoint", {**state, name: {}})
        refused(resume, "does not fit", "use the version of the code")
    for content in CHECKPOINTS.values():
        put_checkpoint(run, content)
        refused(resume, "checkpoint", "another")
    assert not UNPICKLED


@pytest.mark.parametrize(
    ("name", "size"), [("hidden_sizes", (2_000_000_000,)), ("replay_size", 10**15)]
)
def test_sizes_that_are_not_the_checkpoints_take_no_memory(
    run, begin, make_config, refused, name, size
):
    """For settings are compared with those in the checkpoint before anything is made."""
    config = make_config(rl={name: size})
    edit(run / "config.json", algorithm=asdict(config.algorithm))
    resume = partial(begin, run, config, resume=True)
    cause = f"checkpoint holds a run with other settings (algorithm.rl.{name} is"
    refused(resume, cause, "choose another run directory")


def test_a_column_that_is_there_already_is_refused(tmp_path):
    for logged in (("success",), ("loss_meta", "loss_meta")):
        with pytest.raises(ValueError, match=logged[0]):
            open_tables(tmp_path / "run", config={}, logged=logged).__enter__()
    assert not (tmp_path / "run").exists()
