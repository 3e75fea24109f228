"""The experiment with less and less given information: its settings, its runs and its table."""

import json
from dataclasses import replace

from privileged_information import (
    INPUTS,
    InformationArguments,
    privileged_information,
)

from bgpo_trl.configs import RLConfig
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.runs.results import read_table
from suites import nico
from tests.helpers import cells, contents


def test_each_input_has_a_run_and_a_row(tiny, tmp_path):
    ddpg = RLConfig(hidden_sizes=(7,), batch_size=16, warmup_steps=8, replay_size=200)
    arguments = InformationArguments(episodes=2, seeds=(1,), out=tmp_path, rl=ddpg)
    printed = privileged_information(arguments)
    head, *rows = cells(printed)
    assert head == ["policy observes", *nico.PAPER_TASKS, "all"]
    assert [row[0] for row in rows] == list(INPUTS)
    for name in INPUTS:
        config = json.loads((tmp_path / name / "config.json").read_text())
        learner = load_checkpoint(tmp_path / name / "checkpoint")["algorithm"]
        observed = "state" if name == "state+label" else "latent"
        stored = set(learner["replay"]["rows"]) - {"action", "next", "_group"}
        assert stored == {observed, "context"}
        assert ("gwr" in learner) == (name == "latent+behavior")
        assert (config["task_starts"], config["eval_every"]) == ([0, 0, 0], 2)
        assert config["algorithm"]["rl"]["hidden_sizes"] == [7]
        assert (tmp_path / name / "figures" / "success.png").exists()
        bonus = read_table(tmp_path / name / "train.csv")["intrinsic_return"].astype(float) > 0
        assert (bonus == (name in ("latent+phi", "latent+behavior"))).all()

    before = contents(tmp_path)
    assert privileged_information(replace(arguments, resume=True)) == printed
    assert contents(tmp_path) == before
