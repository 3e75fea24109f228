"""Runs whose policy is written by hand, on a task of their own."""

from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModule

from bgpo_trl.algorithms.policy import Policy
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.policy import LoadedRun
from suites import nico
from suites.nico.base import STATE_CENTER, STATE_SCALE


class Scripted:
    """An algorithm of which nothing is used but a policy, a function of the ground truth."""

    device = torch.device("cpu")

    def __init__(self, act):
        center, scale = torch.tensor(STATE_CENTER), torch.tensor(STATE_SCALE)
        self._actor = TensorDictModule(
            lambda state: act(state * scale + center), in_keys=["state"], out_keys=["action"]
        )

    def snapshot(self, index, embedding, task, generator):
        del index, embedding, task, generator
        return Policy(self._actor, "state", {})


@pytest.fixture
def scripted_run(make_config):
    """Makes a run of two seeds on one task, played by a function from ground truth to actions."""

    def make(name, task, act):
        nico.add_task(name, task)
        config = make_config("state", "oracle", tasks=(name,), task_starts=(0,))
        config = replace(config, algorithm=replace(config.algorithm, max_steps=6))
        none_seen = torch.zeros(4, dtype=torch.bool)
        held_out = DemonstrationBank(torch.zeros(4, 32), torch.zeros(4).long(), none_seen, (name,))
        return LoadedRun(config, Scripted(act), None, held_out, [0])

    return make
