"""Files that wandb writes in its offline mode."""

import json
import os
import sys
import time
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
import wandb

from bgpo_trl.runs.dashboard import wandb_logger
from tests.helpers import finish, interrupt

pytestmark = pytest.mark.usefixtures("easy_world")


@pytest.fixture(scope="module", autouse=True)
def own_wandb(tmp_path_factory):
    """Isolate wandb from its other users and from any server."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith("WANDB_")]:
            patch.delenv(name)
        for name in ("CACHE", "CONFIG", "DATA", "ARTIFACT"):
            patch.setenv(f"WANDB_{name}_DIR", str(home))
        patch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # where nothing answers
        patch.setenv("WANDB_SILENT", "true")
        wandb.teardown()
        yield
        wandb.teardown()


def test_sessions_of_a_run_are_one_run_that_names_no_place_of_this_machine(
    begin, make_config, tmp_path
):
    run = tmp_path / "run"
    start = partial(wandb_logger, run, "offline", "continual-bgpo")
    config = make_config("state", "ddpg")
    interrupt(begin(run, config, loggers=[start]), 12)
    finish(begin(run, config, loggers=[start], resume=True))
    logged = pd.read_csv(run / "eval.csv").groupby("episode")["success"].mean()
    # Another process writes them, and may end after the call that finishes the run.
    deadline = time.monotonic() + 60
    while True:
        files = [*run.glob("wandb/offline-run-*/*.wandb")]
        content = b"".join(path.read_bytes() for path in files)
        if len(files) == 2 and content.count(b"eval/success_mean") >= len(logged):
            break
        assert time.monotonic() < deadline
        time.sleep(0.1)
    identity = (run / "wandb" / "run_id").read_text().encode()
    assert all(identity in path.read_bytes() for path in files)
    assert b"continual-bgpo" in content and b"versions.torch" in content
    for success in logged:
        assert json.dumps(success).encode() in content
    assert {path.name for path in tmp_path.iterdir()} == {"run"}
    others = [path for path in run.glob("wandb/offline-run-*/files/**/*") if path.is_file()]
    for uploaded in (content, *(path.read_bytes() for path in others)):
        for place in (tmp_path, Path.cwd(), Path.home(), sys.prefix, sys.executable):
            assert len(str(place)) < 2 or str(place).encode() not in uploaded
