"""BGPO in a small world."""

from dataclasses import replace

import pytest

from bgpo_trl.algorithms import entry
from bgpo_trl.algorithms.bgpo import BGPO
from tests.algorithms.playing import CHANGES, SCHEDULE, VARIANTS


@pytest.fixture
def make_bgpo(bank, encoders, make_config, in_world):
    """Makes BGPO; its groups have seen the first ``known`` demonstrations, from each seed's on."""

    def make(variant="latent, b", seeds=(3, 8), schedule=SCHEDULE, bank=bank, known=0, **changes):
        state, _, name = VARIANTS[variant]
        config = make_config(state, name).algorithm
        config = replace(config, **{**CHANGES.get(variant, {}), **changes})
        bank = bank.for_tasks(bank.tasks[: schedule.n_tasks])
        algorithm = BGPO(config, seeds=seeds, bank=bank.seen(), encoders=encoders)
        for seed, groups in zip(seeds, algorithm.groups, strict=False):
            for row in range(known):
                shown = (seed + row) % len(bank.seen().task)
                start = None if algorithm.starts is None else algorithm.starts[shown]
                groups.adapt(bank.seen().embedding[shown], start)
        return in_world(algorithm, schedule)

    return make


@pytest.fixture
def make_task_algorithm(bank, encoders, make_config, in_world):
    """Makes MAML or Dist-NLL, of as many tasks as the schedule has."""

    def make(name, seeds=(4, 6), schedule=SCHEDULE, state="state", bank=bank, **changes):
        config = make_config(state, name).algorithm
        config = replace(config, **{"task_batch_size": 4, **changes})
        of_tasks = bank.for_tasks(bank.tasks[: schedule.n_tasks])
        algorithm = entry(name).make(config, seeds=seeds, bank=of_tasks.seen(), encoders=encoders)
        return in_world(algorithm, schedule)

    return make
