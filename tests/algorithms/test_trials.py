"""Trials join what is one task and nothing else, on starts to the left and right of a line."""

import numpy as np
import pytest
import torch

from bgpo_trl.algorithms.experts import GroupTrials

LEFT, RIGHT = torch.tensor([-10.0, 0.0]), torch.tensor([10.0, 0.0])
# Forty demonstrations of each group: two tasks (groups 0 and 1, 2 and 3), each from both sides.
SIDES = [LEFT, RIGHT, LEFT, RIGHT]
NOISE = torch.randn(160, 2, generator=torch.Generator().manual_seed(0))
STARTS = NOISE + torch.stack(SIDES).repeat_interleave(40, 0)


def make(seeds=(3,), groups=(0, 1, 2, 3), **options):
    """Trials of which the demonstrations of some groups have been shown, with no success."""
    trials = GroupTrials(STARTS, seeds=seeds, **options)
    for seed in range(len(seeds)):
        for group in groups:
            for row in range(40 * group, 40 * group + 40):
                trials.begin(seed, STARTS[row], group)
                trials.end(seed, row, False)
        forget(trials, seed)
    return trials


def forget(trials, seed=0):
    groups = torch.arange(4).repeat_interleave(40)
    trials.regroup(seed, groups, [])
    trials.regroup(seed, groups, range(4))


def play(trials, start, shown, successes, episodes, played):
    """Plays episodes until one group has played so many, and succeeded in the first of them."""
    while episodes:
        if trials.begin(0, start, shown) == played:
            trials.end(0, 40 * shown, successes > 0)
            successes, episodes = successes - 1, episodes - 1
        else:
            trials.end(0, 40 * shown, False)


def test_a_start_fits_a_group_whose_demonstrations_began_like_it():
    trials = make()
    for start, fitting in ((LEFT, [0, 2]), (RIGHT, [1, 3]), (0 * LEFT, [])):
        assert [g for g in range(4) if trials.fits(0, start, g)] == fitting
    new = LEFT + torch.randn(300, 2, generator=torch.Generator().manual_seed(1))
    share = np.mean([trials.fits(0, start, 0) for start in new])
    assert 0.8 < share < 1.0
    few = GroupTrials(STARTS, seeds=[0], smallest=4)
    for row in range(4):  # of fewer than four demonstrations, little is known
        assert few.begin(0, RIGHT, 0) == 0
        few.end(0, row, False)
        assert few.fits(0, RIGHT, 0) == (row < 3)


def test_what_fits_is_played_by_its_group_and_else_by_one_that_fits_or_itself():
    trials = make()
    assert {trials.begin(0, LEFT, 2) for _ in range(20)} == {2}
    assert {trials.begin(0, RIGHT, 2) for _ in range(60)} == {1, 2, 3}
    assert trials.begin(0, RIGHT, 2) == trials.playing(0)
    assert {trials.begin(0, 0 * RIGHT, 2) for _ in range(20)} == {2}


def test_what_has_paid_is_played_again():
    trials = make()
    play(trials, RIGHT, 0, successes=9, episodes=10, played=1)
    before = trials.state_dict()
    counts = np.bincount([trials.begin(0, RIGHT, 0) for _ in range(200)], minlength=4)
    assert counts[1] > 150
    # A sampled rate depends on the number of the trial, not on others that were drawn before.
    trials.load_state_dict(before)
    again = np.bincount([trials.begin(0, RIGHT, 0) for _ in range(200)], minlength=4)
    assert again.tolist() == counts.tolist()


def test_a_seed_makes_the_choices_that_it_makes_alone():
    alone, both = make([7]), make([3, 7])
    choices = [alone.begin(0, RIGHT, 0) for _ in range(40)]
    for expected in choices:
        both.begin(0, RIGHT, 0)
        assert both.begin(1, RIGHT, 0) == expected
    assert choices != [make([3]).begin(0, RIGHT, 0) for _ in range(40)]


@pytest.mark.parametrize(
    ("there", "back", "joined"),
    [
        ((5, 10), (5, 10), True),
        ((3, 5), (2, 5), True),
        ((3, 5), (1, 5), False),  # four successes
        ((5, 5), (0, 4), False),  # four episodes one way
        ((8, 10), (0, 5), False),  # half of 50 % of 5 is 1.25; less a deviation of 1.12, 0.13
        ((8, 10), (1, 10), True),  # half of 50 % of 10 is 2.5; less a deviation of 1.58, 0.92
        ((10, 10), (1, 20), False),  # half of 50 % of 20 is 5; less a deviation of 2.24, 2.76
    ],
)
def test_two_groups_are_one_task_if_each_pays_after_the_demonstrations_of_the_other(
    there, back, joined
):
    """Each succeeds in half the episodes after its own; the expected numbers are by hand."""
    trials = make()
    play(trials, LEFT, 0, 10, 20, played=0)
    play(trials, RIGHT, 1, 10, 20, played=1)
    play(trials, RIGHT, 0, *there, played=1)
    play(trials, LEFT, 1, *back, played=0)
    assert trials.same_task(0) == ((0, 1) if joined else None)


@pytest.mark.parametrize("seed", range(3))
def test_only_groups_of_one_task_are_joined(seed):
    """An expert succeeds in half the episodes of its task that begin on its side, else in 5 %."""
    trials, rng, joined = make([seed]), np.random.default_rng(seed), set()
    for _ in range(600):
        side, shown = rng.integers(2), int(rng.integers(4))
        noise = torch.from_numpy(rng.normal(size=2)).float()
        played = trials.begin(0, (LEFT, RIGHT)[side] + noise, shown)
        paid = played // 2 == shown // 2 and played % 2 == side
        trials.end(0, 40 * shown, rng.random() < (0.5 if paid else 0.05))
        if (pair := trials.same_task(0)) is not None:
            joined.add(pair)
            forget(trials)
    assert joined == {(0, 1), (2, 3)}


def test_counts_of_groups_that_are_no_more_are_forgotten():
    trials = make()
    for start, shown, episodes, played in (
        (LEFT, 0, 20, 0), (RIGHT, 1, 20, 1), (RIGHT, 0, 10, 1), (LEFT, 1, 10, 0),
    ):  # fmt: skip
        play(trials, start, shown, episodes // 2, episodes, played)
    assert trials.same_task(0) == (0, 1)
    trials.regroup(0, torch.zeros(160, dtype=torch.int64), [0, 2, 3])
    assert trials.same_task(0) is None
    assert trials.fits(0, RIGHT, 0)


def test_a_state_is_a_copy_and_restores_everything():
    trials = make([1, 2])
    play(trials, RIGHT, 0, 5, 10, played=1)
    trials.begin(1, LEFT, 3)
    saved, other = trials.state_dict(), GroupTrials(STARTS, seeds=[1, 2])
    other.load_state_dict(saved)
    for _ in range(20):
        assert other.begin(0, RIGHT, 0) == trials.begin(0, RIGHT, 0)
        assert other.playing(1) == trials.playing(1)
        other.end(0, 0, True)
        trials.end(0, 0, True)
    assert str(other.state_dict()) == str(trials.state_dict()) != str(saved)
