"""Means on dashboards, against means computed by hand; loggers that fail or are missing."""

import sys
import types

import numpy as np
import pandas as pd
import pytest
import torch

from bgpo_trl.runs import dashboard
from bgpo_trl.runs.dashboard import Dashboard, tensorboard_logger, wandb_logger
from bgpo_trl.runs.directory import RunLogger
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

    def make(*loggers, played=(), tested=(), **options):
        with RunLogger(tmp_path, config=SETTINGS, resume=True) as log:
            log.truncate_to({})
            for row in played:
                log.log_train(row)
            for row in tested:
                log.log_eval({name: row[name] for name in ("seed", "episode", "task", "success")})
        return Dashboard(tmp_path, loggers, settings=SETTINGS, **options)

    return make


@pytest.mark.parametrize("per_seed", [False, True])
def test_an_evaluation_logs_means_over_seeds_of_tests_and_training(make, per_seed):
    recorder = Recorder()
    with make(recorder, per_seed=per_seed) as board:
        for row in PLAYED:
            board.log_train(row)
        board.log_eval(evaluation(2))
        diverged = episode(8, 3, "push", 1, loss_actor=float("nan"), num_nodes=2)
        board.log_train(diverged)
        board.log_eval(evaluation(4, seeds=(8,)))
    assert recorder.closed
    (first, first_step), (second, second_step) = recorder.metrics
    assert (first_step, second_step) == (2, 4)
    expected = {
        "eval/success/grasp": 1 / 4,
        "eval/success/push": 3 / 4,
        "eval/success_mean": 1 / 2,
        "eval/success_sd": 1 / 4,  # of 3/4 and 1/4
        **MEANS,
    }
    for (seed, task), successes in TESTED.items():
        if per_seed:
            expected[f"eval/success/{task}/seed_{seed}"] = np.mean(successes)
    assert first == pytest.approx(expected)
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
    found = {name: value for name, value in second.items() if "/seed_" not in name}
    assert found == pytest.approx(expected, nan_ok=True)


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


def test_final_tests_media_and_settings_are_logged_as_plain_values(make, tmp_path, monkeypatch):
    monkeypatch.setattr(dashboard, "commit_of_code", lambda: "c0ffee")
    recorder = Recorder()
    with make(recorder) as board:
        final = [{"task": "grasp", "success": 0.5}, {"task": "grasp", "success": 0.75}]
        final.append({"task": "push", "success": 0.25})
        board.log_final(pd.DataFrame(final), 6)
        board.log_media("figures/success", tmp_path / "success.png")
    means = {"final/success/grasp": 0.625, "final/success/push": 0.25, "final/success_mean": 0.5}
    assert recorder.metrics == [(means, 6)]
    assert recorder.media == [("figures/success", tmp_path / "success.png")]
    (found,) = recorder.settings
    assert found.pop("versions.torch") == torch.__version__
    assert {name: value for name, value in found.items() if "versions." not in name} == {
        "gamma": 0.98,
        "seeds": "[3, 8]",
        "network.hidden": "[64]",
        "network.rate": None,
        "commit": "c0ffee",
    }


@pytest.mark.parametrize("method", ["log_hparams", "log_metrics", "log_media", "shutdown"])
def test_a_logger_that_fails_is_dropped_with_one_warning(make, method, monkeypatch, tmp_path):
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
            board.log_media("figures/success", tmp_path / "success.png")
    assert len(caught) == len(calls) == 1
    assert (len(intact.metrics), len(intact.media), intact.closed) == (2, 2, True)


@pytest.fixture
def unreachable(monkeypatch):
    """Have `WandbLogger` fail in modes, as without a network; returns these and what is made."""
    modes, made = [], []

    def logger(name, *, mode, group, **options):
        if mode in modes:
            raise ConnectionError("no route\nto host")
        made.append((mode, group))

    monkeypatch.setattr(dashboard, "WandbLogger", logger)
    return modes, made


def test_wandb_logs_offline_when_it_does_not_answer(unreachable, make, tmp_path):
    modes, made = unreachable
    modes.append("online")
    with pytest.warns(UserWarning, match=r"\(no route\): logging offline") as caught:
        wandb_logger(tmp_path, "online", group="mine")
    assert len(caught) == 1
    assert made == [("offline", "mine")]

    modes.append("offline")
    with pytest.warns(UserWarning) as caught:
        board = make(lambda: wandb_logger(tmp_path, "online"))
    messages = [str(warning.message).partition(" (")[0] for warning in caught]
    assert messages == ["wandb does not answer", "A logger failed"]
    board.log_eval(evaluation(2))  # the run goes on without it


@pytest.mark.parametrize(
    ("package", "make_logger"),
    [("wandb", lambda run: wandb_logger(run, "offline")), ("tensorboard", tensorboard_logger)],
)
def test_a_missing_package_is_one_warning(package, make_logger, make, monkeypatch, tmp_path):
    attribute = {"wandb": "_has_wandb", "tensorboard": "_has_tb"}[package]
    monkeypatch.setattr(f"torchrl.record.loggers.{package}.{attribute}", False)
    with pytest.warns(UserWarning, match=rf"pip install 'bgpo_trl\[{package}\]'") as caught:
        make(lambda: make_logger(tmp_path)).close()
    assert len(caught) == 1


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
        board.log_media("figures/success", tmp_path / "success.png")
    assert closed == [str(tmp_path / "tensorboard")]
    assert {name: value for name, value, _ in written if name in MEANS} == pytest.approx(MEANS)
    assert {step for *_, step in written} == {2}
