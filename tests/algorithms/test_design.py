"""The table of keys in ``docs/design.md`` is that of an episode."""

import re
from pathlib import Path

import pytest
import torch

from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import play

pytestmark = pytest.mark.usefixtures("easy_world")
PAGE = Path(__file__).parents[2] / "docs" / "design.md"


def rows():
    """Yield key, dtype, shape for one seed, writers and time of each line of the table."""
    table = PAGE.read_text().split("| key | shape | written by | when |\n|---|---|---|---|\n")[1]
    for line in table.split("\n\n")[0].splitlines():
        keys, shapes, writers, when = line.strip("|").split(" | ")
        names = re.findall(r"`(\w+)`", keys)
        found = re.findall(r"(\w+ )?`\[S((?:, \d+)*)\]`", shapes)
        assert len(found) in (1, len(names)), line
        for name, (dtype, shape) in zip(names, found * (len(names) // len(found)), strict=True):
            sizes = [int(size) for size in shape.split(", ")[1:]]
            dtype = getattr(torch, dtype.strip() or "float32")
            yield name, dtype, sizes, re.findall(r"`(\w+)`", writers), when.strip()


def test_the_table_of_keys_is_that_of_a_rollout(make_bgpo):
    algorithm = make_bgpo("all", schedule=TaskSchedule((0, 0, 0)), known=15)
    world = algorithm.world
    frames = world.simulation.reset()["pixels"]
    data, _ = play(algorithm, 30)
    entries = {**data["next"], **data, "pixels": frames.unsqueeze(1)}
    assert data["step_count"].eq(0).sum() > 4  # episodes
    table = {key: row for key, *row in rows()}
    assert table.keys() | {"next", "pre_tanh_action"} >= entries.keys() >= table.keys()
    transforms = [*world.env.transform]
    written = {type(t).__name__: t.out_keys for t in transforms if t.out_keys}
    written["NicoEnv"] = [*world.simulation.observation_spec.keys(), "reward"]
    for key, (dtype, sizes, writers, when) in table.items():
        assert (entries[key].dtype, [*entries[key].shape[2:]]) == (dtype, sizes), key
        assert entries[key].shape[0] == 2
        for writer in written.keys() & {*writers}:
            assert key in written[writer], (key, writer)
        assert when in ("at reset", "each step")
        if when == "at reset":
            later = data["step_count"].flatten(1)[:, 1:] > 0
            assert entries[key][:, 1:][later].equal(entries[key][:, :-1][later]), key
