"""The log of a run in its directory, mirrored to a stand-in for Weights & Biases."""

import json
from pathlib import Path

import pytest
import torch

import bgpo_trl.runs.logger
from bgpo_trl.runs.logger import EVAL_COLUMNS, TRAIN_COLUMNS, RunLogger

CONFIG = {"gamma": 0.98, "network": {"hidden": [64]}}
ROW = {
    "algorithm": "bgpo",
    "seed": 2,
    "episode": 7,
    "env_steps": 210,
    "task": "grasp_glass",
    "success": True,
    "return": 1.0,
    "steps": 28,
}


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir() if path.is_file()}


def test_a_run_writes_its_settings_and_two_csv_files(tmp_path):
    directory = tmp_path / "runs" / "first"
    with RunLogger(directory, config=CONFIG) as logger:
        logger.log_train({**ROW, "intrinsic_return": torch.tensor(0.25)})
        logger.log_eval(ROW)
        sizes = {name: (directory / name).stat().st_size for name in ("train.csv", "eval.csv")}
        assert logger.position() == sizes
        with pytest.raises(ValueError, match="loss_meta"):
            logger.log_train({"loss_meta": 0.5})
    found = contents(directory)
    assert json.loads(found.pop("config.json")) == CONFIG
    assert found == {
        "train.csv": (
            f"{','.join(TRAIN_COLUMNS)}\nbgpo,2,7,210,grasp_glass,1,1.0,28,0.25,,,,,\n"
        ).encode(),
        "eval.csv": f"{','.join(EVAL_COLUMNS)}\nbgpo,2,7,210,grasp_glass,1,1.0,28\n".encode(),
    }


def write(logger: RunLogger, episodes: range) -> None:
    for episode in episodes:
        logger.log_train({**ROW, "episode": episode, "loss_actor": 1 / (episode + 1)})
        if episode % 2:
            logger.log_eval({**ROW, "episode": episode})


@pytest.mark.parametrize("checkpoint_at", [None, 5])
def test_a_resumed_run_writes_the_same_files_as_an_uninterrupted_one(checkpoint_at, tmp_path):
    with RunLogger(tmp_path / "straight", config=CONFIG) as logger:
        write(logger, range(20))

    killed = RunLogger(tmp_path / "resumed", config=CONFIG)
    position = {}
    if checkpoint_at is not None:
        write(killed, range(checkpoint_at))
        position = killed.position()
    write(killed, range(checkpoint_at or 0, 9))

    with RunLogger(tmp_path / "resumed", config=CONFIG, resume=True) as logger:
        logger.truncate_to(position)
        write(logger, range(checkpoint_at or 0, 20))
    assert contents(tmp_path / "resumed") == contents(tmp_path / "straight")


@pytest.mark.parametrize("resume", [False, True])
def test_a_directory_with_other_settings_is_refused_unchanged(resume, tmp_path):
    with RunLogger(tmp_path, config=CONFIG) as logger:
        logger.log_eval(ROW)
    before = contents(tmp_path)
    other = {"gamma": 0.95, "network": {"hidden": [64]}, "beta": 0.1}
    with pytest.raises(ValueError, match="other settings") as error:
        RunLogger(tmp_path, config=other, resume=resume)
    message = str(error.value)
    assert "(gamma is 0.98 there and 0.95 here; beta is absent there and 0.1 here)" in message
    assert contents(tmp_path) == before


def test_a_run_is_continued_only_on_request(tmp_path):
    RunLogger(tmp_path, config=CONFIG).close()
    with pytest.raises(ValueError, match="already holds a run: resume it"):
        RunLogger(tmp_path, config=CONFIG)


class FakeWandb:
    """Stands in for TorchRL's WandbLogger, with modes and calls that fail as a dead network."""

    made: list[dict]
    calls: list
    unreachable: tuple[str, ...] = ()
    fail_from = float("inf")

    def __init__(self, exp_name, **kwargs):
        if kwargs["mode"] in self.unreachable:
            raise ConnectionError("no route\nto host")
        self.made.append({"exp_name": exp_name, **kwargs})

    def log_metrics(self, metrics, step):
        if len(self.calls) >= self.fail_from:
            raise ConnectionError("no route\nto host")
        self.calls.append((metrics, step))

    def shutdown(self):
        self.calls.append("shutdown")


@pytest.fixture
def wandb(monkeypatch):
    class Fake(FakeWandb):
        made: list[dict] = []  # noqa: RUF012 fresh for each test
        calls: list = []  # noqa: RUF012

    monkeypatch.setattr(bgpo_trl.runs.logger, "WandbLogger", Fake)
    return Fake


def test_the_mirror_gets_every_number_of_a_row(wandb, tmp_path):
    with RunLogger(tmp_path, config={}, wandb="online") as logger:
        logger.log_eval({**ROW, "return": torch.tensor(0.5)})
        logger.log_train({"episode": 8, "loss_actor": 2.0, "num_nodes": None})
    values = {"env_steps": 210, "success": 1, "return": 0.5, "steps": 28}
    assert wandb.calls == [
        ({f"eval/grasp_glass/seed_2/{name}": value for name, value in values.items()}, 7),
        ({"train/all/seed_0/loss_actor": 2.0}, 8),
        "shutdown",
    ]


def test_a_failing_mirror_is_disabled_with_one_warning(wandb, tmp_path):
    wandb.fail_from = 1
    with (
        pytest.warns(UserWarning, match=r"failed \(no route\) and is disabled") as caught,
        RunLogger(tmp_path, config={}, wandb="online") as logger,
    ):
        for _ in range(4):
            logger.log_eval(ROW)
    assert len(caught) == 1
    assert len((tmp_path / "eval.csv").read_text().splitlines()) == 5


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_wandb_gets_the_settings_and_keeps_its_run_when_resumed(mode, wandb, tmp_path):
    for resume in (False, True):
        with RunLogger(tmp_path / "a", config=CONFIG, wandb=mode, resume=resume) as logger:
            logger.log_eval(ROW)
    RunLogger(tmp_path / "b", config=CONFIG, wandb=mode).close()
    first, resumed, other = wandb.made
    assert first == resumed
    assert first["id"] != other["id"]
    assert (first["mode"], first["config"]) == (mode, CONFIG)


@pytest.mark.parametrize(
    ("unreachable", "modes"), [(("online",), ["offline"]), (("online", "offline"), [])]
)
def test_an_unreachable_wandb_does_not_end_the_run(unreachable, modes, wandb, tmp_path):
    wandb.unreachable = unreachable
    with (
        pytest.warns(UserWarning, match=r"\(no route\): "),
        RunLogger(tmp_path, config={}, wandb="online") as logger,
    ):
        logger.log_eval(ROW)
    assert [made["mode"] for made in wandb.made] == modes
    assert len((tmp_path / "eval.csv").read_text().splitlines()) == 2


def test_a_missing_wandb_package_is_one_warning(monkeypatch, tmp_path):
    monkeypatch.setattr("torchrl.record.loggers.wandb._has_wandb", False)
    with (
        pytest.warns(UserWarning, match=r"pip install 'bgpo_trl\[wandb\]'") as caught,
        RunLogger(tmp_path, config={}, wandb="online") as logger,
    ):
        logger.log_eval(ROW)
    assert len(caught) == 1
    assert len((tmp_path / "eval.csv").read_text().splitlines()) == 2
