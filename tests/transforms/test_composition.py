"""All transforms together, as a training run composes them."""

import pytest
import torch
from torchrl.envs import SerialEnv, check_env_specs

from tests.transforms.environment import make_env, play


def test_a_partial_reset_changes_only_its_rows():
    env = make_env([0, 1, 2], lengths=9)
    running = env.step_mdp(env.rand_step(env.reset()))
    before = running.clone()
    mask = torch.tensor([[False], [True], [False]])
    after = env.reset(running.set("_reset", mask))
    fresh = make_env([0, 1, 2], lengths=9).reset()
    for key in fresh.keys():  # noqa: SIM118
        assert after[key][[0, 2]].equal(before[key][[0, 2]])
        torch.testing.assert_close(after[key][1], fresh[key][1])
    assert not before["lae_h"][1].equal(fresh["lae_h"][1])


@pytest.mark.parametrize("use_buffers", [True, False])
def test_each_worker_can_have_a_composition_of_its_own(use_buffers):
    workers = [lambda: make_env(lengths=9), lambda: make_env(lengths=4)]
    env = SerialEnv(2, workers, use_buffers=use_buffers)
    check_env_specs(env)
    together, _ = play(env, 12)
    alone, _ = play(make_env(lengths=4), 12)
    for key, value in together[1].items(True, True):
        torch.testing.assert_close(alone[key], value)


def test_collected_data_is_not_overwritten():
    env = make_env([0, 1], [2, 4])
    data, kept, copies = env.reset(), [], []
    for _ in range(9):
        data["action"] = torch.full((2, 4), 0.5)
        step, data = env.step_and_maybe_reset(data)
        kept.append(step)
        copies.append(step.clone())
    assert (torch.stack(kept) == torch.stack(copies)).all()
