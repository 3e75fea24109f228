import dataclasses
import json
import warnings
from pathlib import Path

import pytest
import torch
from torchrl.record.loggers import Logger

import bgpo_trl.runs.logger
from bgpo_trl.runs.logger import EVAL_COLUMNS, TRAIN_COLUMNS, RunLogger

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


@dataclasses.dataclass(frozen=True)
class Network:
    hidden: tuple[int, ...] = (64,)


@dataclasses.dataclass(frozen=True)
class Config:
    gamma: float = 0.98
    data: Path = Path("data")
    network: Network = Network()


class Recorder(Logger):
    """Keeps what it is given; raises from the n-th call on."""

    def __init__(self, fail_from: float = float("inf")):
        super().__init__("recorder", "")
        self.calls: list = []
        self.fail_from = fail_from

    def _create_experiment(self):
        return None

    def log_metrics(self, metrics, step=None, **_):
        if len(self.calls) >= self.fail_from:
            raise ConnectionError("no route\nto host")
        self.calls.append((metrics, step))
        return metrics

    def log_scalar(self, name, value, step=None): ...
    def log_video(self, name, video, step=None, **kwargs): ...
    def log_hparams(self, cfg): ...
    def log_histogram(self, name, data, **kwargs): ...
    def __repr__(self):
        return "Recorder()"


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir() if path.is_file()}


def test_a_run_leaves_its_settings_and_two_csv_files(tmp_path):
    directory = tmp_path / "runs" / "first"
    with RunLogger(directory, config=Config()) as logger:
        logger.log_train({**ROW, "intrinsic_return": torch.tensor(0.25)})
        logger.log_eval(ROW)
    assert json.loads((directory / "config.json").read_text()) == {
        "gamma": 0.98,
        "data": "data",
        "network": {"hidden": [64]},
    }
    assert (directory / "train.csv").read_text() == (
        f"{','.join(TRAIN_COLUMNS)}\nbgpo,2,7,210,grasp_glass,1,1.0,28,0.25,,,,,\n"
    )
    assert (directory / "eval.csv").read_text() == (
        f"{','.join(EVAL_COLUMNS)}\nbgpo,2,7,210,grasp_glass,1,1.0,28\n"
    )
    assert set(contents(directory)) == {"config.json", "train.csv", "eval.csv"}


def write(logger: RunLogger, episodes: range) -> None:
    for episode in episodes:
        logger.log_train({**ROW, "episode": episode, "loss_actor": 1 / (episode + 1)})
        if episode % 2:
            logger.log_eval({**ROW, "episode": episode})


@pytest.mark.parametrize("checkpoint_at", [None, 5])
def test_a_resumed_run_leaves_the_same_files_as_one_that_never_stopped(checkpoint_at, tmp_path):
    with RunLogger(tmp_path / "straight", config=Config()) as logger:
        write(logger, range(20))

    killed = RunLogger(tmp_path / "resumed", config=Config())
    position = {}
    if checkpoint_at is not None:
        write(killed, range(checkpoint_at))
        position = killed.position()
    write(killed, range(checkpoint_at or 0, 9))

    with RunLogger(tmp_path / "resumed", config=Config(), resume=True) as logger:
        logger.truncate_to(position)
        write(logger, range(checkpoint_at or 0, 20))
    assert contents(tmp_path / "resumed") == contents(tmp_path / "straight")


def test_position_fits_into_a_checkpoint(tmp_path):
    with RunLogger(tmp_path, config={}) as logger:
        logger.log_eval(ROW)
        assert logger.position() == {
            name: (tmp_path / name).stat().st_size for name in ("train.csv", "eval.csv")
        }


@pytest.mark.parametrize("resume", [False, True])
def test_a_directory_with_other_settings_is_refused_untouched(resume, tmp_path):
    with RunLogger(tmp_path, config=Config()) as logger:
        logger.log_eval(ROW)
    before = contents(tmp_path)
    other = Config(gamma=0.95, network=Network(hidden=(64, 64)))
    with pytest.raises(ValueError, match="other settings") as error:
        RunLogger(tmp_path, config=other, resume=resume)
    message = str(error.value)
    assert "gamma is 0.98 there and 0.95 here; network.hidden is [64] there" in message
    assert "data" not in message.replace(str(tmp_path), "")
    assert "\n" not in message
    assert contents(tmp_path) == before


def test_a_setting_that_only_one_side_has_counts_as_other(tmp_path):
    RunLogger(tmp_path, config={"gamma": 1.0}).close()
    with pytest.raises(ValueError, match=r"beta is absent there and 0\.1 here"):
        RunLogger(tmp_path, config={"gamma": 1.0, "beta": 0.1}, resume=True)


def test_a_run_is_never_continued_by_accident(tmp_path):
    with RunLogger(tmp_path, config=Config()) as logger:
        logger.log_eval(ROW)
    with pytest.raises(ValueError, match="already holds a run: resume it"):
        RunLogger(tmp_path, config=Config())


def test_a_column_that_there_is_not_is_refused(tmp_path):
    with (
        RunLogger(tmp_path, config={}) as logger,
        pytest.raises(ValueError, match=r"train.csv has no column loss_meta"),
    ):
        logger.log_train({"loss_meta": 0.5})


def test_mirrors_get_every_number_of_a_row(tmp_path):
    mirrors = [Recorder(), Recorder()]
    with RunLogger(tmp_path, config={}, mirrors=mirrors) as logger:
        logger.log_eval({**ROW, "return": torch.tensor(0.5)})
        logger.log_train({"episode": 8, "loss_actor": 2.0, "num_nodes": None})
    prefix = "eval/grasp_glass/seed_2"
    expected = [
        (
            {
                f"{prefix}/env_steps": 210,
                f"{prefix}/success": 1,
                f"{prefix}/return": 0.5,
                f"{prefix}/steps": 28,
            },
            7,
        ),
        ({"train/all/seed_0/loss_actor": 2.0}, 8),
    ]
    assert [mirror.calls for mirror in mirrors] == [expected, expected]
    assert not any(mirror.is_alive for mirror in mirrors)


def test_a_failing_mirror_is_dropped_with_one_warning(tmp_path):
    broken, sound = Recorder(fail_from=1), Recorder()
    with (
        warnings.catch_warnings(record=True) as caught,
        RunLogger(tmp_path, config={}, mirrors=[broken, sound]) as logger,
    ):
        warnings.simplefilter("always")
        for _ in range(4):
            logger.log_eval(ROW)
    assert [str(warning.message) for warning in caught] == [
        "Recorder failed (no route) and is disabled for the rest of this run: "
        "the CSV files are complete."
    ]
    assert len(sound.calls) == 4
    assert len((tmp_path / "eval.csv").read_text().splitlines()) == 5


class FakeWandb(Recorder):
    """Stands in for TorchRL's WandbLogger; refuses the given modes as a dead network would."""

    made: list[dict]
    unreachable: tuple[str, ...] = ()

    def __init__(self, exp_name, **kwargs):
        if kwargs["mode"] in self.unreachable:
            raise ConnectionError("no route\nto host")
        super().__init__()
        self.made.append({"exp_name": exp_name, **kwargs})


@pytest.fixture
def fake_wandb(monkeypatch):
    class Fake(FakeWandb):
        made: list[dict] = []  # noqa: RUF012 fresh for each test

    monkeypatch.setattr(bgpo_trl.runs.logger, "WandbLogger", Fake)
    return Fake


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_wandb_gets_the_settings_and_keeps_its_run_when_resumed(mode, fake_wandb, tmp_path):
    for resume in (False, True):
        with RunLogger(tmp_path / "a", config=Config(), wandb=mode, resume=resume) as logger:
            logger.log_eval(ROW)
    RunLogger(tmp_path / "b", config=Config(), wandb=mode).close()
    first, resumed, other = fake_wandb.made
    assert first == resumed
    assert first["id"] != other["id"]
    assert first["mode"] == mode
    assert first["config"]["network"] == {"hidden": [64]}


def test_without_network_wandb_goes_offline_with_one_warning(fake_wandb, tmp_path):
    fake_wandb.unreachable = ("online",)
    with pytest.warns(UserWarning, match=r"\(no route\): logging offline, .*wandb sync") as caught:
        RunLogger(tmp_path, config={}, wandb="online").close()
    assert len(caught) == 1
    assert [made["mode"] for made in fake_wandb.made] == ["offline"]


def test_wandb_that_cannot_even_go_offline_does_not_end_the_run(fake_wandb, tmp_path):
    fake_wandb.unreachable = ("online", "offline")
    with (
        pytest.warns(UserWarning, match="kept in its CSV files only") as caught,
        RunLogger(tmp_path, config={}, wandb="offline") as logger,
    ):
        logger.log_eval(ROW)
    assert len(caught) == 1
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


def test_an_unknown_wandb_mode_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(ValueError, match='wandb must be "online", "offline" or None'):
        RunLogger(tmp_path / "run", config={}, wandb="on")  # pyright: ignore[reportArgumentType]
    assert not (tmp_path / "run").exists()
