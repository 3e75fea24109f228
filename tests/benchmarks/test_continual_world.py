"""Encoders and bank of the benchmark on Continual World's tasks. Needs Meta-World."""

from dataclasses import replace

import pytest

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.encoders.representation import load_representation
from bgpo_trl.scenes import SCENES, find_scene
from tests.helpers import TINY_ENCODERS

pytest.importorskip("metaworld", reason="Meta-World is not installed (docs/extending.md)")

import examples.continual_world  # noqa: F401 - adds the scene
from benchmarks import continual_world

pytestmark = pytest.mark.slow
TINY = replace(TINY_ENCODERS, inverse=continual_world.WITHOUT_INVERSE)


@pytest.mark.filterwarnings("ignore:encoders:UserWarning")
def test_encoders_of_the_first_tasks_embed_demonstrations_of_all(tmp_path, monkeypatch):
    tasks = ("faucet-close", "handle-press-side")
    monkeypatch.setitem(SCENES, "cw10", replace(find_scene("cw10"), default_tasks=tasks))
    made = continual_world.make_encoders(tmp_path, 2, 1, TINY)

    encoders = load_representation(made[0], scene=find_scene("cw10"))
    bank = DemonstrationBank.load(made[1], encoder_id=encoders.identity)
    assert bank.tasks == tasks
    assert bank.train.sum() == 2 * len(tasks)
    written = made[1].stat().st_mtime_ns
    assert continual_world.make_encoders(tmp_path, 2, 1, TINY) == made
    assert made[1].stat().st_mtime_ns == written
