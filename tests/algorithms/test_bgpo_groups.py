"""BGPO with groups of behaviors: experts, balanced replay, and demonstrations as experience."""

import itertools
from dataclasses import replace

import pytest
import torch

from bgpo_trl.transforms import TaskSchedule
from tests.algorithms.playing import assert_same, perceptron, play
from tests.helpers import spied

pytestmark = pytest.mark.usefixtures("easy_world")


def test_with_one_group_it_is_the_plain_learner_bit_for_bit(make_bgpo):
    lonely = {"group_size": 99, "active_groups": 4, "expert_batch_size": 16}
    plain, one = make_bgpo("latent, b"), make_bgpo("experts", **lonely)
    ours, theirs = play(plain, 30)[0], play(one, 30)[0]
    assert all(groups.numbers == [0] for groups in one.groups)
    for key in ("action", "latent", "behavior", "demo_index", ("next", "reward")):
        assert ours[key].equal(theirs[key]), key
    assert_same(plain.learner.state_dict(), one.learner.state_dict())


def test_joined_groups_have_one_expert_and_one_replay(make_bgpo, bank):
    algorithm = make_bgpo("all", schedule=TaskSchedule((0, 0, 0)), known=15)
    _, state = play(algorithm, 60)
    shown, groups = bank.seen().embedding, algorithm.groups[1]
    before, pair = groups.lookup(shown).group, groups.numbers[:2]
    pairs = iter([tuple(pair)])
    groups.trials.same_task = lambda: next(pairs, None)
    play(algorithm, 7, state)
    assert next(pairs, None) is None
    after = groups.lookup(shown).group
    (joined,) = after[(before == pair[0]) | (before == pair[1])].unique().tolist()
    assert joined in pair
    (other,) = {*pair} - {joined}
    assert other not in groups.numbers
    assert other not in algorithm.active.group[1]
    assert other not in algorithm.proposals.state_dict()["groups"][1]
    for replay in (algorithm.replay, algorithm.shown._shown):
        entries, group = replay.contents(1)
        assert group.equal(after[entries["demo_index"]])
        assert joined in group


def test_who_plays_is_decided_at_reset_and_acts_until_the_end(make_bgpo, bank):
    """Another expert than the group's in each episode; actions are those of its networks."""
    quiet = replace(make_bgpo("clone").config.rl, noise=0.0, averaging=0.0)
    algorithm = make_bgpo("clone", known=15, rl=quiet)
    began, ended, played = [], [], []
    for seed, groups in enumerate(algorithm.groups):

        def expert(start, group, seed=seed, groups=groups):
            began.append((seed, start.clone(), group))
            return groups.numbers[group == groups.numbers[0]], False

        groups.expert = expert
        groups.end = lambda *played, seed=seed, **of: ended.append((seed, *played, of))

    def watch(state):
        for seed in range(2):
            weights = algorithm.actor_weights(seed, int(state["expert"][seed]))
            x = torch.cat([state["latent"][seed], state["context"][seed]])
            torch.testing.assert_close(state["action"][seed], perceptron(weights, x).tanh())
        played.append(algorithm.active.group)

    data, _ = play(algorithm, 30, watch=watch)
    starts = data["step_count"].squeeze(-1) == 0
    assert len(began) - 2 <= starts.sum() and starts.sum() > 4
    for seed, start, group in began[: int(starts.sum())]:
        rows = (data["latent"][seed] == start).all(-1) & starts[seed]
        assert rows.any() and (data["group"][seed][rows] == group).any()
    assert (data["group"] != data["expert"]).all()
    assert not data["group_fits"].any()
    ends = data[data["next", "done"].squeeze(-1)]
    assert sorted((group, expert) for _, group, expert, _ in ended) == sorted(
        zip(ends["group"].tolist(), ends["expert"].tolist(), strict=True)
    )
    successes = [of["success"] for *_, of in ended]
    assert sum(successes) == ends["next", "success"].sum() > 0
    entries, group = algorithm.replay.contents(0)
    shown = bank.seen().embedding[entries["demo_index"]]
    assert group.equal(algorithm.groups[0].lookup(shown).group)


def test_trials_of_experts_are_played_as_such(make_bgpo):
    algorithm = make_bgpo("all", schedule=TaskSchedule((0, 0, 0)), known=15)
    begin, told = algorithm.proposals.begin, []

    def watched(seed, group, *, trial):
        told.append((seed, group, trial))
        return begin(seed, group, trial=trial)

    algorithm.proposals.begin = watched
    for groups in algorithm.groups:
        fits = itertools.cycle([True, False])
        groups.expert = lambda _, group, fits=fits: (group, next(fits))
    data, _ = play(algorithm, 30)
    starts = (data["step_count"] == 0).squeeze(-1).T.nonzero().tolist()
    begun = [data[seed, step] for step, seed in starts]
    seeds = [seed for _, seed in starts]
    expected = [(int(at["expert"]), not at["group_fits"]) for at in begun]
    assert told == [(seed, *of) for seed, of in zip(seeds, expected, strict=True)]
    assert {trial for _, _, trial in told} == {True, False}


@pytest.mark.parametrize("variant", ["group-balanced replay", "all"])
def test_an_update_sees_as_much_of_each_group_played_last(make_bgpo, bank, variant):
    algorithm = make_bgpo(variant, schedule=TaskSchedule((0, 0, 0)), known=15)
    learned, actives = spied(algorithm, "learn"), []
    data, _ = play(algorithm, 50, watch=lambda _: actives.append(algorithm.active.group))
    frames = bank.seen().steps.latents(torch.arange(len(bank.seen().steps.latent)))
    n_experts, n_shown = (2, 2) if variant == "all" else (1, 0)
    n_full = 0
    for step, ((batch,), _) in enumerate(learned, 50 - len(learned)):
        assert batch.shape == (2, n_experts, 16 // n_experts)
        for seed in range(2):
            groups, past = actives[step][seed].tolist(), data["group"][seed, :step]
            n_full += -1 not in groups
            latents = batch["latent"][seed].reshape(16, 1, 64)
            played = (latents == data["latent"][seed, :step]).all(-1)
            demonstrated = (latents == frames).all(-1).any(-1).tolist()
            weight = batch["priority_weight"][seed].flatten().tolist()
            for row in range(16):
                if algorithm.config.experts:
                    group = groups[row // 8]
                else:
                    group = [g for g in groups if g >= 0][row % (2 - groups.count(-1))]
                is_shown = row % 8 >= 8 - n_shown
                if weight[row]:
                    of_group = bool((past[played[row]] == group).any())
                    assert (of_group, demonstrated[row]) == (not is_shown, is_shown)
                else:  # nothing is known of the group, or no demonstration of it was over
                    assert is_shown or not (past == group).any()
            if variant == "all":
                imitated = batch["imitation"][seed]
                drawn = imitated["latent"][imitated["priority_weight"] > 0]
                assert (drawn.unsqueeze(1) == frames).all(-1).any(-1).all()
    assert n_full > 20


def test_own_successes_of_the_group_are_a_share_of_what_is_imitated(make_bgpo, bank):
    """Where a group has none yet, all is demonstrated."""
    rl = replace(make_bgpo("all").config.rl, success_share=0.25)
    algorithm = make_bgpo("all", schedule=TaskSchedule((0, 0, 0)), known=15, rl=rl)
    learned, actives = spied(algorithm, "learn"), []
    data, _ = play(algorithm, 60, watch=lambda _: actives.append(algorithm.active.group))
    frames = bank.seen().steps.latents(torch.arange(len(bank.seen().steps.latent)))
    episode = data["next", "done"].squeeze(-1).cumsum(1) - data["next", "done"].squeeze(-1).int()
    n_own, n_lacking = 0, 0
    for step, ((batch,), _) in enumerate(learned, 60 - len(learned)):
        for seed in range(2):
            won = episode[seed, :step][data["next", "success"][seed, :step, 0]]
            succeeded = torch.isin(episode[seed, :step], won)
            for place, group in enumerate(actives[step][seed].tolist()):
                imitated = batch["imitation"][seed, place]
                if group < 0 or not bool((imitated["priority_weight"] > 0).all()):
                    continue
                rows = imitated["latent"].unsqueeze(1)
                of_group = succeeded & (data["group"][seed, :step] == group)
                own = (rows == data["latent"][seed, :step][of_group]).all(-1).any(-1)
                demonstrated = (rows == frames).all(-1).any(-1)
                n = 2 if of_group.any() else 0
                assert own[:n].all() and demonstrated[n:].all()
                n_own, n_lacking = n_own + n, n_lacking + (n == 0)
    assert n_own > 20 and n_lacking > 2


def test_a_failure_that_ends_an_episode_is_no_success_to_imitate(make_bgpo):
    """Such as a fall, which terminates the episode too."""
    rl = replace(make_bgpo("all").config.rl, success_share=0.25)
    algorithm = make_bgpo("all", rl=rl)
    ended = play(make_bgpo("all"), 1)[0][:, 0]
    for success in (False, True):
        for key, value in (("done", True), ("terminated", True), ("success", success)):
            ended["next", key] = torch.full((2, 1), value)
        algorithm.store(ended)
        drawn = algorithm.replay.draw(ended["group"].unsqueeze(1), successes=True)
        assert (drawn["priority_weight"] == success).all()


def test_nothing_is_known_of_tasks_that_have_not_been_presented(make_bgpo, bank):
    """All that is in the bank of two of the three tasks is something else in one of two runs."""
    later = bank.task > 0
    of_later = torch.repeat_interleave(later, bank.steps.length)
    sign = 1 - 2 * of_later.to(torch.int8).unsqueeze(-1)
    steps = replace(bank.steps, latent=bank.steps.latent * sign, action=bank.steps.action * sign)
    embedding = bank.embedding * (1 - 3 * later.unsqueeze(-1))
    other = replace(bank, embedding=embedding, steps=steps)
    schedule = TaskSchedule((0, 99, 99))
    both = [make_bgpo("all", schedule=schedule, bank=one) for one in (bank, other)]
    ours, theirs = (play(one, 25)[0] for one in both)
    assert (ours == theirs).all()
    assert_same(*(one.learner.state_dict() for one in both))
    shown, task = bank.embedding[:6].view(3, 2, 32), torch.zeros(3, 2).long()
    for index in range(2):
        policies = [one.snapshot(index, shown, task, torch.Generator()) for one in both]
        assert_same(*(policy.state_dict() for policy in policies))
