"""BGPO in a small world."""

from dataclasses import replace

import pytest

from bgpo_trl.algorithms.bgpo import BGPO
from tests.algorithms.bgpo_variants import CHANGES, SCHEDULE, VARIANTS


@pytest.fixture
def make_bgpo(bank, encoders, make_config, in_world):
    def make(
        variant="latent, b",
        seeds=(3, 8),
        schedule=SCHEDULE,
        bank=bank,
        rl=None,
        config=None,
        **changes,
    ):
        state, _, kind, name = VARIANTS[variant]
        changes = {"variant": kind, **({} if config is None else {"rl": config}), **changes}
        config = make_config(state, name if rl is None else f"{name}+{rl}").algorithm
        config = replace(config, **{**CHANGES.get(variant, {}), **changes})
        bank = bank.for_tasks(bank.tasks[: schedule.n_tasks])
        algorithm = BGPO(config, seeds=seeds, bank=bank.seen(), encoders=encoders)
        return in_world(algorithm, seeds, schedule, bank)

    return make
