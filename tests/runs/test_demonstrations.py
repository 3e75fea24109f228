"""Encoders and demonstrations of a run, found again from its directory."""

import shutil
from dataclasses import replace

import pytest

from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.representation import save_representation
from bgpo_trl.runs.config_file import Digests
from bgpo_trl.runs.demonstrations import BANK, keep_inputs, load_inputs, own_weights
from suites import nico

TASKS = nico.PAPER_TASKS


@pytest.fixture(scope="module")
def shipped():
    return load_pretrained()


@pytest.fixture(scope="module")
def mixed(shipped):
    """Demonstrations of a shipped task and of another name."""
    bank = shipped[1]
    own = replace(bank.for_tasks([TASKS[0]]), tasks=("juggle",))
    return (own + bank.for_tasks([TASKS[1]])).for_tasks([TASKS[1], "juggle"])


@pytest.mark.parametrize("tasks", [TASKS, TASKS[1:], TASKS[::-1]])
def test_shipped_demonstrations_are_not_copied(shipped, tmp_path, tasks):
    encoders, bank = shipped
    bank = bank.for_tasks(tasks)
    keep_inputs(tmp_path, bank, encoders)
    assert list(tmp_path.iterdir()) == []
    found = load_inputs(tmp_path, tasks, Digests(encoders.identity, bank.identity))[1]
    assert (found.tasks, found.identity) == (tasks, bank.identity)


def test_own_demonstrations_move_with_the_run(shipped, mixed, tmp_path):
    encoders, _ = shipped
    (tmp_path / "run").mkdir()
    keep_inputs(tmp_path / "run", mixed, encoders)
    shutil.move(tmp_path / "run", tmp_path / "moved")
    digests = Digests(encoders.identity, mixed.identity)
    found = load_inputs(tmp_path / "moved", mixed.tasks, digests)[1]
    assert found.tasks == mixed.tasks
    for name in ("embedding", "task", "train"):
        assert getattr(found, name).equal(getattr(mixed, name))
    assert found.identity == mixed.identity
    shutil.rmtree(tmp_path / "moved")


def test_demonstrations_of_another_run_are_refused(shipped, mixed, tmp_path):
    encoders, bank = shipped
    digests = Digests(encoders.identity, mixed.identity)
    with pytest.raises(ValueError, match=r"^the bank has no demonstration of 'juggle'"):
        load_inputs(tmp_path, mixed.tasks, digests)
    with pytest.raises(
        ValueError,
        match=rf"demonstrations {mixed.identity[:12]}, not with .*: put its own at .*run",
    ) as error:
        load_inputs(tmp_path / "run", TASKS, digests)
    assert str(error.value).endswith(str(tmp_path / "run" / BANK))
    earlier = Digests(encoders.identity, None)  # Runs of earlier versions did not say.
    assert load_inputs(tmp_path, TASKS, earlier)[1].identity == bank.identity


def test_other_encoders_and_a_changed_scene_are_told_apart(shipped, tmp_path):
    encoders, bank = shipped
    foreign = replace(encoders, metadata={**encoders.metadata, "scene_version": "mars-1"})
    own_weights(tmp_path).parent.mkdir()
    save_representation(foreign, own_weights(tmp_path))
    digests = Digests(foreign.identity, bank.identity)
    with pytest.raises(ValueError, match=r"was trained in the scene mars-1, this is .*: use the"):
        load_inputs(tmp_path, TASKS, digests)
    with pytest.raises(ValueError, match=r"was trained with the encoders 0123, not with .*: put"):
        load_inputs(tmp_path, TASKS, digests._replace(encoders="0123"))
