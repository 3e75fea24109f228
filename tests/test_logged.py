"""Runs that begin with logged episodes."""

import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from bgpo_trl.algorithms.proposal_trials import ProposalTrials
from bgpo_trl.data.dataset import load_demonstrations, write_demonstrations, write_logged_episodes
from bgpo_trl.encoders.representation import Representation
from bgpo_trl.logged import LoggedEpisodes, replay_logged
from bgpo_trl.modules.group_trials import GroupTrials
from bgpo_trl.scenes.nico import NICO
from tests.helpers import finish, interrupt, interrupt_call, rows, spied
from tests.scenes.dot import scene as dot_scene
from tests.test_training import assert_same_run

pytestmark = pytest.mark.usefixtures("easy_world")
GRASP, PUSH, LATER = "grasp_glass", "push_green_to_glass", "push_green_to_white"


def episode(n_steps, *, success, seed=0, shape=(32, 64), size=4):
    """An episode of noise."""
    noise = np.random.default_rng(seed)
    return {
        "pixels": noise.integers(0, 256, (n_steps + 1, *shape, 3), dtype=np.uint8),
        "action": noise.uniform(-1, 1, (n_steps, size)).astype(np.float32),
        "success": success,
    }


LOG = {
    GRASP: [episode(3, success=True, seed=1), episode(2, success=False, seed=2)],
    PUSH: [episode(1, success=True, seed=3), episode(6, success=False, seed=4)],
}
EPISODES = [one for some in LOG.values() for one in some]
N_STEPS = 3 + 2 + 1 + 6


@pytest.fixture
def log(tmp_path):
    """Folder of four logged episodes."""
    write_logged_episodes(tmp_path / "log", LOG, scene="nico")
    return tmp_path / "log"


@pytest.fixture
def logged_config(make_config):
    """Settings of a run in which the tasks of the log are presented from the start."""

    def make(name="bgpo", **changes):
        return make_config(name=name, **{"task_starts": (0, 0, 4), **changes})

    return make


@pytest.fixture
def learned(begin, logged_config, log, tmp_path):
    """Return the algorithm of a run that has got the logged episodes and not begun to play."""

    def make(name="bgpo", **changes):
        with begin(tmp_path / f"{name}-{len(changes)}", logged_config(name, **changes)) as trainer:
            replay_logged(trainer.algorithm, LoggedEpisodes.load(log), progress=False)
        return trainer.algorithm

    return make


def test_the_replay_holds_the_log(learned, encoders: Representation, bank):
    algorithm = learned()
    for seed in range(2):
        held, group = algorithm.replay.contents(seed)
        assert len(held) == N_STEPS
        of_task = bank.seen().task[held["demo_index"]]
        assert of_task.tolist() == [0] * 5 + [1] * 7
        at = 0
        for one in EPISODES:
            own, at = held[at : at + len(one["action"])], at + len(one["action"])
            latent = encoders.frame_network.latent(torch.from_numpy(one["pixels"]))
            bounded = latent.clamp(-5, 5)
            torch.testing.assert_close(own["latent"], bounded[:-1], rtol=0, atol=1e-5)
            torch.testing.assert_close(own["next", "latent"], bounded[1:], rtol=0, atol=1e-5)
            assert torch.equal(own["action"], torch.from_numpy(one["action"]))
            assert own["demo_index"].unique().numel() == 1
            # The context is the scaled behavior, by which the bonus is measured.
            behavior = own["context"][0] / algorithm.config.behavior_scale
            phi = encoders.lae.encode(latent[None], torch.tensor([len(latent)]))[0]
            bonus = algorithm.beta * (-(behavior - phi).norm()).exp()
            last = [False] * (len(own) - 1) + [True]
            reward = torch.tensor(last).float() * (one["success"] + bonus)
            torch.testing.assert_close(own["next", "reward"][:, 0], reward, rtol=0, atol=1e-5)
            assert own["next", "done"].flatten().tolist() == last
            terminated = own["next", "terminated"].flatten().tolist()
            assert terminated == [one["success"] and end for end in last]
        assert (group == 0).all()
    indices = [algorithm.replay.contents(seed)[0]["demo_index"] for seed in range(2)]
    assert (indices[0] != indices[1]).any()


def test_a_failure_ends_as_a_timeout_of_the_algorithm(learned):
    held, _ = learned(algorithm={"timeouts_bootstrap": False}).replay.contents(0)
    assert torch.equal(held["next", "terminated"], held["next", "done"])
    assert held["next", "done"].flatten().nonzero().flatten().tolist() == [2, 4, 5, 11]


@pytest.mark.parametrize(
    "name", ["maml-demonstrations", "dist-nll-demonstrations", "oracle-demonstrations", "ewc"]
)
def test_other_algorithms_get_the_same_transitions(learned, name):
    ours, theirs = (learned(of).replay.contents(1)[0] for of in ("bgpo", name))
    for key in ("latent", "action", ("next", "latent"), ("next", "terminated")):
        assert torch.equal(ours[key], theirs[key])
    assert theirs["next", "reward"].flatten().nonzero().flatten().tolist()[:1] == [2]


def test_demonstrations_are_learned_and_no_success_is_counted(learned):
    algorithm = learned(seeds=(3,))
    assert len(algorithm.shown) == len(EPISODES)
    assert algorithm.groups[0].shown.sum() == len(EPISODES)
    assert int(algorithm.gwr.num_nodes[0]) >= 2
    fresh = GroupTrials(algorithm.groups[0].trials.seed)
    assert algorithm.groups[0].trials.state_dict() == fresh.state_dict()
    rl = algorithm.config.rl
    none = ProposalTrials(1, clone_episodes=rl.clone_episodes, clone_share=rl.clone_share)
    assert algorithm.proposals.state_dict() == none.state_dict()


def test_a_run_learns_from_the_log_before_its_own_episodes(begin, logged_config, log, tmp_path):
    config = logged_config(offline_updates=4, seeds=(3,))
    logged = torch.from_numpy(np.concatenate([one["action"] for one in EPISODES]))
    with begin(tmp_path / "run", config, logged=log) as trainer:
        learned = spied(trainer.algorithm.learner, "learn")
        interrupt(trainer, N_STEPS + 1)
    for (batch,), _ in learned[:4]:  # 8 rows, of which a quarter is of demonstrations
        known = (batch["action"][0, 0, :, None] == logged).all(-1).any(-1)
        assert known.tolist() == [True] * 6 + [False] * 2
        assert (batch["priority_weight"] == 1).all()
    finish(begin(tmp_path / "run", config, resume=True))
    train = rows(tmp_path / "run" / "train.csv")
    assert [int(row["episode"]) for row in train] == [*range(1, config.episodes + 1)]
    assert int(train[0]["env_steps"]) == int(train[0]["steps"])


def test_an_interrupted_run_equals_one_that_is_not(begin, logged_config, log, tmp_path):
    config = logged_config(offline_updates=3)
    finish(begin(tmp_path / "straight", config, logged=log))
    run = tmp_path / "run"
    trainer = begin(run, config, logged=log)
    interrupt_call(trainer, trainer.algorithm, "store_logged", 8)
    trainer = begin(run, config, logged=log, resume=True)
    interrupt_call(trainer, trainer.algorithm.learner, "learn", 2)
    interrupt(begin(run, config, logged=log, resume=True), N_STEPS + 5)
    shutil.rmtree(log)  # learned before the first checkpoint
    finish(begin(run, config, resume=True))
    assert_same_run(run, tmp_path / "straight")
    assert len(json.loads((run / "config.json").read_text())["logged"]) == 64


def test_seeds_alone_equal_seeds_of_a_batch(begin, logged_config, log, tmp_path):
    made = []
    for seeds in ((3, 8), (8,)):
        config = logged_config(seeds=seeds, offline_updates=3)
        trainer = begin(tmp_path / f"{len(seeds)}", config, logged=log)
        interrupt(trainer, N_STEPS + 1)
        made.append(trainer.algorithm)
    both, alone = made
    for ours, theirs in zip(both.replay.contents(1), alone.replay.contents(0), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-5)
    first, second = both.actor_weights(1), alone.actor_weights(0)
    for key, value in first.items():
        torch.testing.assert_close(value, second[key], rtol=0, atol=1e-5)


GROUND_TRUTH = {"algorithm": {"state": "state", "beta": 0.0, "demonstration_share": 0.0}}
GROUND_TRUTH |= {"rl": {"proposals": "actor", "imitation": 0.0}}
DOT = {"left": [episode(2, success=True, shape=(16, 24), size=1)]}


@pytest.mark.parametrize(
    ("log", "changes", "cause", "remedy"),
    [
        (DOT, {}, "is of the scene dot dot-1", "take what is of 'nico'"),
        ({LATER: LOG[PUSH]}, {}, f"episodes of ['{LATER}']", "task_starts"),
        ({GRASP: [episode(7, success=False)]}, {}, "7 steps", "raise max_steps"),
        (LOG, {"rl": {"replay_size": 8, "batch_size": 8}}, "12 steps, the replay holds 8", "raise"),
        (LOG, {"rl": {"proposals": "clone"}}, "learns from demonstrations alone", "leave them out"),
        (LOG, GROUND_TRUTH, "no ['state']", "choose an algorithm"),
    ],
)
def test_a_log_that_does_not_fit_is_refused(
    begin, logged_config, tmp_path, refused, log, changes, cause, remedy
):
    write_logged_episodes(tmp_path / "log", log, scene=dot_scene() if log is DOT else "nico")
    call = partial(begin, tmp_path / "run", logged_config(**changes), logged=tmp_path / "log")
    refused(call, cause, remedy)


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"action": np.full((2, 4), np.nan)}, "has numbers in action that are not finite"),
        ({"action": np.full((2, 4), 1.5)}, "an action of size 1.5"),
        ({"success": 1}, "has the success 1: give True or False"),
        ({"reward": 1.0}, "give 'pixels', 'action', 'success'"),
    ],
)
def test_episodes_that_are_not_logged_as_they_should_be_are_not_written(
    tmp_path, refused, changes, cause
):
    log = {GRASP: [{**episode(2, success=True), **changes}]}
    write = partial(write_logged_episodes, tmp_path / "log", log, scene="nico")
    refused(write, f"episode 0 of {GRASP!r}", cause)


def test_actions_that_are_nan_in_the_file_are_refused(logged_config, log):
    logged = LoggedEpisodes.load(log)
    broken = replace(logged, episodes=logged.episodes.clone())
    broken.episodes["action"][0, 0] = torch.nan
    config = logged_config()
    logged.check(config, NICO)
    with pytest.raises(ValueError, match="must have actions of 4 numbers"):
        broken.check(config, NICO)


def test_logged_episodes_are_no_demonstrations_nor_these_a_log(log, tmp_path, refused):
    refused(lambda: load_demonstrations(log), "may have failed", "--logged")
    shown = {name: LOG[GRASP][0][name] for name in ("pixels", "action")}
    write_demonstrations(tmp_path / "shown", {GRASP: [shown]}, scene="nico", held_out_per_task=0)
    load = partial(LoggedEpisodes.load, tmp_path / "shown")
    refused(load, "does not say which episodes succeeded", "write_logged_episodes")


def test_other_logs_are_refused_when_a_run_is_resumed(begin, logged_config, log, tmp_path, refused):
    run, other = tmp_path / "run", tmp_path / "other"
    interrupt(begin(run, logged_config(), logged=log), N_STEPS + 2)
    write_logged_episodes(other, {GRASP: LOG[GRASP]}, scene="nico")
    again = partial(begin, run, logged_config(), resume=True)
    refused(partial(again, logged=other), "logged is ", "choose another")
    shutil.rmtree(run / "checkpoint")
    for name in ("train.csv", "eval.csv"):
        (run / name).unlink()
    refused(again, "logged is ", "choose another")
