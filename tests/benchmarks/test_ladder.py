"""The ladder: its settings, its runs and its table."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import pytest
import tyro

from benchmarks import ladder
from bgpo_trl.algorithms.rl import RL
from bgpo_trl.configs import DDPGConfig
from bgpo_trl.files.checkpoint import load_checkpoint
from bgpo_trl.runs.results import read_table
from suites import nico
from tests.folders import contents

TASKS = nico.PAPER_TASKS


def test_the_ladder_takes_the_settings_of_each_rl_algorithm():
    for rl, entry in RL.items():
        line = ["--rungs", "a", "--out", "here", rl, "--learning-rate", "0.5"]
        arguments = tyro.cli(Annotated[ladder.Arguments, tyro.conf.OmitArgPrefixes], args=line)
        assert arguments.rl == replace(entry.config, learning_rate=0.5)
        assert (arguments.rungs, arguments.out) == (("a",), Path("here"))


def test_the_ladder_has_a_row_and_a_run_for_each_rung(tiny, tmp_path, capsys):
    ddpg = DDPGConfig(hidden_sizes=(7,), batch_size=16, warmup_steps=8, replay_size=200)
    arguments = ladder.Arguments(episodes=2, seeds=(1,), out=tmp_path, rl=ddpg)
    ladder.main(arguments)
    printed = capsys.readouterr().out
    lines = printed.splitlines()
    assert lines[0] == "| rung | " + " | ".join([*TASKS, "all", "episodes to 80 %"]) + " |"
    assert [line[:5] for line in lines[2:]] == ["| (a)", "| (b)", "| (c)", "| (d)"]
    assert all(re.search(r"\| (\d+|not reached) \|$", line) for line in lines[2:])
    seen = {}
    for rung in "abcd":
        config = json.loads((tmp_path / rung / "config.json").read_text())
        learner = load_checkpoint(tmp_path / rung / "checkpoint")["algorithm"]
        inputs = set(learner["replay"]["rows"]) - {"action", "next", "group"}
        seen[rung] = (config["algorithm"]["state"], inputs, "gwr" in learner)
        assert (config["task_starts"], config["eval_every"]) == ([0, 0, 0], 2)
        assert config["algorithm"]["rl"]["hidden_sizes"] == [7]
        assert (tmp_path / rung / "figures" / "success.png").exists()
        train = read_table(tmp_path / rung / "train.csv")
        assert set(train["algorithm"]) == {config["name"]} == {f"rung {rung}"}
        assert ((train["intrinsic_return"].astype(float) > 0) == (rung in "cd")).all()
    assert seen == {
        "a": ("state", {"state", "context"}, False),
        "b": ("latent", {"latent", "context"}, False),
        "c": ("latent", {"latent", "context"}, False),
        "d": ("latent", {"latent", "context"}, True),
    }

    before = contents(tmp_path)
    ladder.main(replace(arguments, resume=True))
    assert contents(tmp_path) == before
    assert capsys.readouterr().out == printed
    with pytest.raises(ValueError, match="already holds a run"):
        ladder.main(arguments)
