"""An environment of one's own, which has no more than docs/extending.md asks for."""

from functools import partial

import numpy as np
import pytest
from PIL import Image
from torchrl.envs import EnvBase, check_env_specs

from bgpo_trl.experiments.arguments import DoctorArguments, OneShotArguments, WatchArguments
from bgpo_trl.experiments.doctor import check_robot
from bgpo_trl.experiments.watch import one_shot, watch
from bgpo_trl.runs.results import read_table
from bgpo_trl.scenes import SCENES, SimulationEnv
from bgpo_trl.scenes.check import check_scene
from tests.helpers import finish
from tests.scenes.dot import TASKS, SavedDot, pretrain, record_some, run_config, scene, trainer_of


class Batched(EnvBase):
    """Dots that are simulated as one."""

    def __init__(self, make, tasks, *, batch_size=(), **options):
        dots = SimulationEnv(make, tasks, batch_size=batch_size, **options)
        super().__init__(batch_size=dots.batch_size, device="cpu")
        for kind in ("observation", "state", "action", "reward", "done"):
            setattr(self, f"{kind}_spec", getattr(dots, f"{kind}_spec").clone())
        self.seed_rows, self.frames, self.dots = dots.seed_rows, dots.frames, [dots]

    def _reset(self, tensordict=None, **kwargs):
        return self.dots[0]._reset(tensordict, **kwargs)

    def _step(self, tensordict):
        return self.dots[0]._step(tensordict)

    def _set_seed(self, seed):
        self.dots[0]._set_seed(seed)


@pytest.fixture
def own(monkeypatch):
    robot = scene(SavedDot, env=Batched)
    monkeypatch.setitem(SCENES, "dot", robot)
    return robot


def test_a_run_learns_in_it_and_its_policy_plays_there(own, tmp_path, refused):
    """Without a state of the simulation, it is not resumed; demonstrators need a `Simulation`."""
    check_env_specs(own.simulate(TASKS, batch_size=[2]))
    pretrained, run = pretrain(scene(), tmp_path), tmp_path / "run"
    with pytest.warns(UserWarning, match="'dot' cannot be saved: if it is interrupted"):
        finish(trainer_of(run, pretrained))
    assert len(read_table(run / "train.csv")) == 2 * 4
    again = partial(trainer_of, run, pretrained, run_config(episodes=6), resume=True)
    refused(again, "simulations of the scene 'dot' cannot be saved", "begin another")
    film = tmp_path / "film"
    film.mkdir()
    for number in range(3):
        Image.fromarray(np.zeros((16, 24, 3), np.uint8)).save(film / f"{number}.png")
    asked = OneShotArguments(run=run, demonstration=film, task="left")
    assert one_shot(asked).splitlines()[-1].startswith("left: ")
    refused(lambda: watch(WatchArguments(run=run)), "'dot', which has no sim", "write dem")


def test_it_is_neither_checked_nor_recorded(own, tmp_path, refused):
    assert check_scene(own) == []
    assert "frames a second" in check_robot(DoctorArguments(scene="dot"))
    refused(lambda: record_some(tmp_path / "new", own), "act in the Batched", "write dem")
