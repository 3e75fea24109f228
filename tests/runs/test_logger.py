"""The log of a run in its directory."""

import json
from pathlib import Path

import pytest
import torch

from bgpo_trl.runs.directory import EVAL_COLUMNS, TRAIN_COLUMNS, RunLogger

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


@pytest.mark.parametrize("logged", [("success",), ("loss_meta", "loss_meta")])
def test_a_column_that_is_there_already_is_refused(logged, tmp_path):
    with pytest.raises(ValueError, match=logged[0]):
        RunLogger(tmp_path / "run", config=CONFIG, logged=logged)
    assert not (tmp_path / "run").exists()
