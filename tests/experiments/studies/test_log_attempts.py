"""Attempts with noise are logged as they were executed, whether they succeed or not."""

import numpy as np
import pytest
from log_attempts import LogArguments, attempt, log_attempts

from bgpo_trl.logged import LoggedEpisodes
from bgpo_trl.scenes.nico import NICO, NicoEnv

TASK = "push_green_to_white"


def test_without_noise_an_attempt_is_a_demonstration_and_with_much_it_fails():
    env = NicoEnv([TASK])
    (simulation,) = env.simulations
    demonstrated, tried = (attempt(simulation, NICO, TASK, noise, seed=3) for noise in (0.0, 5.0))
    assert demonstrated["success"] and not tried["success"]
    assert np.array_equal(demonstrated["pixels"][0], tried["pixels"][0])
    assert len(tried["action"]) == NICO.max_steps == len(tried["pixels"]) - 1
    assert np.abs(tried["action"]).max() == pytest.approx(1.0)
    assert np.abs(demonstrated["action"]).max() < 1
    env.close()


def test_the_command_writes_what_a_run_reads(tmp_path):
    arguments = LogArguments(tmp_path / "log", tasks=(TASK,), episodes=2, noise=0.0)
    said = log_attempts(arguments)
    logged = LoggedEpisodes.load(tmp_path / "log")
    assert said == f"{TASK}: {int(logged.episodes['success'].sum())} of 2 succeed"
    assert logged.tasks == (TASK,)
