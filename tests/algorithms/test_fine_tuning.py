"""Fine-tuning, and EWC in training: DDPG that is given task boundaries."""

from dataclasses import replace

import pytest
import torch

from bgpo_trl.algorithms import entry
from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import assert_same, play, weights
from tests.helpers import DISTINCT

pytestmark = pytest.mark.usefixtures("easy_world")
SEEDS = (1, 2)
# Steps after which tasks begin: before the warm-up of 8 steps has ended, in the middle of training,
# and two tasks at once.
BOUNDARIES = {5: [(0, 1)], 20: [(1, 1)], 31: [(0, 2)], 33: [(1, 2), (1, 0)]}


@pytest.fixture
def make(bank, encoders, make_config, in_world):
    def make(name, seeds=SEEDS, **changes):
        config = replace(make_config(name=name).algorithm, **changes)
        algorithm = entry(name).make(config, seeds=seeds, bank=bank.seen(), encoders=encoders)
        return in_world(algorithm, TaskSchedule((0, 0, 0)))

    return make


def copies(algorithm, index):
    return [weight[index].detach().clone() for weight in weights(algorithm)]


def test_until_the_first_boundary_it_is_ddpg_bit_for_bit(make):
    ddpg = make("ddpg")
    theirs = play(ddpg, 30)[0]
    for name in ("fine-tuning", "ewc"):
        algorithm = make(name)
        assert (play(algorithm, 30)[0] == theirs).all()
        state = algorithm.learner.state_dict()
        assert state["optimizer"]["state"]
        for part in ("loss", "optimizer"):
            assert_same(state[part], ddpg.learner.state_dict()[part])
        assert_same(algorithm.replay.state_dict(), ddpg.replay.state_dict())


def test_only_fine_tuning_and_ewc_are_reported_to_need_boundaries(make):
    needing = {name for name in DISTINCT if make(name).needs_boundaries}
    assert needing == {"fine-tuning-demonstrations", "ewc-demonstrations"}


def test_after_a_boundary_only_what_came_since_is_learned_from(make):
    algorithm = make("fine-tuning-demonstrations")
    _, state = play(algorithm, 20)
    algorithm.begin_task(1, 1)
    data, _ = play(algorithm, 12, state)
    assert [len(algorithm.replay.contents(index)[0]) for index in range(2)] == [32, 12]
    assert algorithm.replay.contents(1)[0]["latent"].equal(data[1]["latent"])

    shown = data[1]["demo_index"][data[1]["next", "done"].flatten()].unique()
    drawn = []
    algorithm.learn = lambda batch: drawn.append(batch) or {}
    for _ in range(20):
        algorithm.update()
    # A quarter of 16 transitions, and what is imitated.
    of_shown = [(batch["latent"][..., -4:, :], batch["imitation", "latent"]) for batch in drawn]
    learned = torch.cat([latent[1, 0] for pair in of_shown for latent in pair])
    steps = algorithm.bank.steps
    frames = [steps.first[row] + torch.arange(int(steps.length[row])) for row in shown]
    own = steps.latents(torch.cat(frames))
    assert len(learned) == 20 * (4 + 16)
    assert (learned.unsqueeze(1) == own).all(-1).any(-1).all()


@pytest.mark.parametrize("name", ["fine-tuning-demonstrations", "ewc-demonstrations"])
def test_a_seed_rests_until_its_replay_has_filled_again(make, name):
    algorithm = make(name)
    _, state = play(algorithm, 20)
    algorithm.begin_task(1, 1)
    learning, resting = copies(algorithm, 0), copies(algorithm, 1)
    warmup = algorithm.config.rl.warmup_steps
    _, state = play(algorithm, warmup, state)
    assert_same(copies(algorithm, 1), resting)
    assert all(not now.equal(old) for now, old in zip(copies(algorithm, 0), learning, strict=True))
    play(algorithm, 4, state)
    assert all(not now.equal(old) for now, old in zip(copies(algorithm, 1), resting, strict=True))


@pytest.mark.parametrize("source", ["", "-demonstrations"])
def test_ewc_is_fine_tuning_until_a_boundary_and_without_weight(make, source):
    for weight, boundaries in ((1e4, None), (0.0, BOUNDARIES)):
        algorithm, plain = make(f"ewc{source}", ewc_weight=weight), make(f"fine-tuning{source}")
        ours, theirs = (play(one, 50, boundaries=boundaries)[0] for one in (algorithm, plain))
        assert (ours == theirs).all()
        for part in ("loss", "optimizer"):
            assert_same(algorithm.learner.state_dict()[part], plain.learner.state_dict()[part])
    assert all(fisher.any() for fisher in algorithm.learner.fisher.values())


def test_a_task_begins_like_a_new_expert_of_bgpo(make):
    algorithm = make("fine-tuning-demonstrations")
    learner, trials = algorithm.learner, algorithm.proposals
    trials.clone_episodes = 3

    def successes(seed, n_episodes):
        """Who plays: whether the clone does."""
        alone = []
        for _ in range(n_episodes):
            alone.append(trials.begin(seed, 0))
            trials.end(seed, success=True, group=0)
        return alone

    _, state = play(algorithm, 20)
    for seed in range(2):
        successes(seed, 500)  # so many that failures before are forgotten
    algorithm.begin_task(1, 1)
    assert learner.loss.n_imitated.flatten().gt(0).tolist() == [True, False]
    assert [trials.clone_is_better(seed, 0) for seed in range(2)] == [False, True]
    assert [all(successes(seed, 3)) for seed in range(2)] == [False, True]
    while not learner.n_averaged[1]:
        _, state = play(algorithm, 1, state)
    latest = dict(learner.loss.named_parameters())
    for name, average in learner.average.items():
        assert average[1].equal(latest[name][1])
        assert not average[0].equal(latest[name][0])


def test_a_seed_that_imitates_its_successes_learns_as_alone_while_another_rests(make):
    rl = replace(make("fine-tuning-demonstrations").config.rl, success_share=0.5)
    both, alone = (make("fine-tuning-demonstrations", seeds, rl=rl) for seeds in (SEEDS, (2,)))
    play(both, 40, boundaries={20: [(0, 1)]})
    play(alone, 40)
    for ours, own in zip(copies(both, 1), copies(alone, 0), strict=True):
        torch.testing.assert_close(ours, own)


def test_ewc_consolidates_once_where_several_tasks_begin_at_once(make):
    once, twice = make("ewc"), make("ewc")
    for algorithm, tasks in ((once, [(0, 1)]), (twice, [(0, 1), (0, 2)])):
        play(algorithm, 20, boundaries={19: tasks})
    assert_same(once.learner.state_dict(), twice.learner.state_dict())
