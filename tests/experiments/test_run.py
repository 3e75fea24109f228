"""Demonstrations of a run of the command line."""

from dataclasses import replace

import pytest

from bgpo_trl.experiments import run as experiment
from suites import nico

ONE, TWO, THREE = nico.PAPER_TASKS


@pytest.fixture
def own(bank, encoders, monkeypatch, tmp_path):
    """Path of a bank of two tasks, one of them shipped under the same name."""
    bank = replace(bank, encoder_id=encoders.identity)
    monkeypatch.setattr(experiment, "load_pretrained", lambda *_, **__: (encoders, bank))
    path = tmp_path / "own.safetensors"
    other = replace(bank, embedding=bank.embedding + 1)
    renamed = replace(other.for_tasks([ONE, TWO]), tasks=("juggle", TWO))
    renamed.save(path)
    return path


def test_tasks_that_the_bank_lacks_are_taken_from_the_package(own, bank):
    found = experiment.pretrained_for(["juggle", TWO, THREE], own)[1]
    assert found.tasks == ("juggle", TWO, THREE)
    for task, name, offset in ((0, ONE, 1), (1, TWO, 1), (2, THREE, 0)):
        shipped = bank.for_tasks([name])
        assert found.of_task(task).embedding.equal(shipped.embedding + offset)
        assert found.of_task(task).train.equal(shipped.train)
    assert experiment.pretrained_for([TWO])[1].embedding.equal(bank.for_tasks([TWO]).embedding)


def test_a_task_that_neither_bank_holds_is_refused(own):
    with pytest.raises(ValueError, match="'dance'"):
        experiment.pretrained_for([TWO, "dance"], own)
