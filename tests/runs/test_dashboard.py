"""Means on dashboards, against means computed by hand; loggers that fail or are missing."""

import contextlib
import sys
import types

import numpy as np
import pandas as pd
import pytest
import torch

from bgpo_trl.runs import dashboard
from bgpo_trl.runs.dashboard import Dashboard, tensorboard_logger
from bgpo_trl.runs.directory import open_tables
from bgpo_trl.runs.results import COLUMNS
from tests.helpers import Recorder

SETTINGS = {"gamma": 0.98, "seeds": [3, 8], "network": {"hidden": [64], "rate": None}}


def episode(seed, number, task, success, **values):
    return {"algorithm": "x", "seed": seed, "episode": number, "task": task, "success": success} | (
        {"env_steps": 10 * number, "group": 5} | values
    )


PLAYED = [
    episode(3, 1, "grasp", 1, loss_actor=-1.0, num_nodes=2),
    episode(3, 2, "grasp", 0, loss_actor=-2.0, num_nodes=4),
    episode(8, 1, "push", 1, loss_actor=-3.0, num_nodes=2),
    episode(3, 3, "push", 0, loss_actor=-9.0, num_nodes=6),  # after the evaluation of episode 2
    episode(8, 2, "grasp", 1, loss_actor=-4.0, num_nodes=2),
]
MEANS = {
    "train/success/grasp": 2 / 3,
    "train/success/push": 1.0,
    "train/success_mean": 3 / 4,
    "train/env_steps": 15.0,
    "train/loss_actor": -2.5,
    "train/num_nodes": 2.5,
}
TESTED = {(3, "grasp"): (1, 0), (3, "push"): (1, 1), (8, "grasp"): (0, 0), (8, "push"): (1, 0)}


def evaluation(number, seeds=(3, 8)):
    return [
        episode(seed, number, task, success)
        for (seed, task), successes in TESTED.items()
        for success in successes
        if seed in seeds
    ]


@pytest.fixture
def make(tmp_path):
    """Make a dashboard of a run that has the rows of its CSV files, none by default."""

    def make(*loggers, played=(), tested=()):
        with open_tables(tmp_path, config=SETTINGS, position={}) as tables:
            for row in played:
                tables["train.csv"].write(row)
            for row in tested:
                kept = ("seed", "episode", "task", "success")
                tables["eval.csv"].write({name: row[name] for name in kept})
        return contextlib.closing(Dashboard(tmp_path, loggers, settings=SETTINGS))

    return make


def test_means_over_seeds_and_plain_settings_are_logged(make, monkeypatch):
    monkeypatch.setattr(dashboard, "commit_of_code", lambda: "c0ffee")
    recorder = Recorder()
    with make(recorder) as board:
        for row in PLAYED:
            board.log_train(row)
        board.log_eval(evaluation(2))
        board.log_train(episode(8, 3, "push", 1, loss_actor=float("nan"), num_nodes=2))
        board.log_eval(evaluation(4, seeds=(8,)))
        board.log_final(pd.DataFrame({"task": ["grasp"] * 2, "success": [0.5, 0.75]}), 6)
    assert recorder.closed
    (first, second, final), steps = zip(*recorder.metrics, strict=True)
    assert steps == (2, 4, 6)
    of_tests = {"eval/success/grasp": 1 / 4, "eval/success/push": 3 / 4, "eval/success_mean": 1 / 2}
    assert first == pytest.approx({**of_tests, **MEANS})
    expected = {
        "eval/success/grasp": 0.0,
        "eval/success/push": 1 / 2,
        "eval/success_mean": 1 / 4,
        "train/success/push": 1 / 2,
        "train/success_mean": 1 / 2,
        "train/env_steps": 30.0,
        "train/loss_actor": float("nan"),  # is seen
        "train/num_nodes": 4.0,
    }
    assert second == pytest.approx(expected, nan_ok=True)
    assert final == {"final/success/grasp": 0.625, "final/success_mean": 0.625}
    (found,) = recorder.settings
    assert found.pop("versions.torch") == torch.__version__
    assert {name: value for name, value in found.items() if "versions." not in name} == {
        "gamma": 0.98,
        "seeds": "[3, 8]",
        "network.hidden": "[64]",
        "network.rate": None,
        "commit": "c0ffee",
    }


def test_a_resumed_run_logs_the_means_of_an_uninterrupted_one(make):
    """Training episodes that no evaluation follows are in the CSV file only."""
    uninterrupted, resumed = Recorder(), Recorder()
    random = np.random.default_rng(0)
    played = [
        dict.fromkeys(COLUMNS["train.csv"], 2)
        | episode(seed, number, "push", number % 2, loss_actor=random.normal())
        for number in range(1, 7)
        for seed in (3, 8)
    ]
    with make(uninterrupted) as board:
        for row in played:
            board.log_train(row)
        board.log_eval(evaluation(2))
        board.log_eval(evaluation(6))
    with make(resumed, played=played[:9], tested=evaluation(2)) as board:
        for row in played[9:]:
            board.log_train(row)
        board.log_eval(evaluation(6))
    assert resumed.metrics == uninterrupted.metrics[1:]


@pytest.mark.parametrize("method", ["log_hparams", "log_metrics", "shutdown"])
def test_a_logger_that_fails_is_dropped_with_one_warning(make, method, monkeypatch):
    broken, intact = Recorder(), Recorder()
    calls = []

    def fail(*args, **kwargs):
        calls.append(args)
        raise ConnectionError("no route\nto host")

    monkeypatch.setattr(broken, method, fail)
    with (
        pytest.warns(UserWarning, match=r"Recorder failed \(no route\)") as caught,
        make(broken, intact) as board,
    ):
        for number in (2, 4):
            board.log_train(episode(3, number, "grasp", 1))
            board.log_eval(evaluation(number))
    assert len(caught) == len(calls) == 1
    assert (len(intact.metrics), intact.closed) == (2, True)


def test_tensorboard_gets_the_means_as_scalars_in_the_run_directory(make, monkeypatch, tmp_path):
    """`SummaryWriter` is a stand-in that takes hyperparameters as strictly as torch's."""
    written, closed = [], []

    class SummaryWriter:
        def __init__(self, log_dir):
            self.log_dir = log_dir

        def add_scalar(self, name, value, global_step):
            written.append((name, value, global_step))

        def add_hparams(self, hparam_dict, metric_dict):
            for value in hparam_dict.values():
                assert value is None or isinstance(value, int | float | str | torch.Tensor)

        def flush(self): ...

        def close(self):
            closed.append(self.log_dir)

    module = types.SimpleNamespace(SummaryWriter=SummaryWriter)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", module)
    monkeypatch.setattr("torchrl.record.loggers.tensorboard._has_tb", True)
    with make(lambda: tensorboard_logger(tmp_path)) as board:
        for row in PLAYED:
            board.log_train(row)
        board.log_eval(evaluation(2))
    assert closed == [str(tmp_path / "tensorboard")]
    assert {name: value for name, value, _ in written if name in MEANS} == pytest.approx(MEANS)
    assert {step for *_, step in written} == {2}
