"""Trials join what is one task and nothing else, on starts to the left and right of a line."""

from copy import deepcopy

import numpy as np
import pytest
import torch

from bgpo_trl.modules.behavior_groups import BehaviorGroups

LEFT, RIGHT = torch.tensor([-10.0, 0.0]), torch.tensor([10.0, 0.0])
# Forty demonstrations of each group: two tasks (groups 0 and 1, 2 and 3), each from both sides.
SIDES = [LEFT, RIGHT, LEFT, RIGHT]
NOISE = torch.randn(160, 2, generator=torch.Generator().manual_seed(0))
STARTS = NOISE + torch.stack(SIDES).repeat_interleave(40, 0)
PLACES = 30 * torch.eye(4).repeat_interleave(40, 0)
EMBEDDINGS = PLACES + torch.randn(160, 4, generator=torch.Generator().manual_seed(1))
SHOWN = BehaviorGroups(4)
for demonstration in zip(EMBEDDINGS, STARTS, strict=True):
    SHOWN.adapt(*demonstration)


def make(seed=3):
    """Groups of which all demonstrations have been shown, before the first episode."""
    groups = deepcopy(SHOWN)
    groups.trials.seed = seed
    return groups


def play(groups, start, shown, successes, episodes, expert):
    """Plays episodes until one expert has played so many, and succeeded in the first of them.

    What would be joined stays apart.
    """
    while episodes:
        played, fits = groups.expert(start, shown)
        groups.trials.count(shown, played, fits=fits, success=played == expert and successes > 0)
        if played == expert:
            successes, episodes = successes - 1, episodes - 1


def experts(groups, start, shown, episodes):
    """The experts that play episodes without success."""
    played = []
    for _ in range(episodes):
        played.append(groups.expert(start, shown)[0])
        groups.trials.count(shown, played[-1], fits=groups.fits(start, shown), success=False)
    return played


def test_a_start_fits_a_group_whose_demonstrations_began_like_it():
    groups = make()
    assert groups.numbers == [0, 1, 2, 3]
    for start, fitting in ((LEFT, [0, 2]), (RIGHT, [1, 3]), (0 * LEFT, [])):
        assert [g for g in range(4) if groups.fits(start, g)] == fitting
    assert groups.expert(LEFT.tolist(), 0) == (0, True)
    assert not groups.fits(RIGHT.double().numpy(), 0)
    new = LEFT + torch.randn(300, 2, generator=torch.Generator().manual_seed(1))
    share = np.mean([groups.fits(start, 0) for start in new])
    assert 0.8 < share < 1.0
    few = BehaviorGroups(4, smallest=4)
    for row in range(4):  # of fewer than four demonstrations, little is known
        assert few.expert(RIGHT, 0) == (0, True)
        few.adapt(EMBEDDINGS[row], STARTS[row])
        assert few.fits(RIGHT, 0) == (row < 3)


def test_starts_that_a_bank_has_rounded_fit_where_all_episodes_begin_alike():
    groups = BehaviorGroups(4, smallest=4)
    for embedding in EMBEDDINGS[:8]:
        groups.adapt(embedding, torch.full((9,), 0.04))
    assert groups.fits(torch.full((9,), 0.0599), 0)  # half a code of 1 / 25 off
    assert not groups.fits(torch.full((9,), 0.07), 0)


def test_starts_are_those_of_all_demonstrations_or_none():
    groups, plain = make(), BehaviorGroups(4)
    plain.adapt(EMBEDDINGS[0])
    for one, start in ((groups, None), (groups, torch.zeros(3)), (plain, LEFT)):
        with pytest.raises(ValueError, match="starts of earlier demonstrations"):
            one.adapt(torch.zeros(4), start)
    assert (len(groups.points), len(plain.points)) == (160, 1)
    assert plain.fits(RIGHT, 0)


def test_what_fits_is_played_by_its_group_and_else_by_one_that_fits_or_itself():
    groups = make()
    assert {*experts(groups, LEFT, 2, 20)} == {2}
    assert {*experts(groups, RIGHT, 2, 60)} == {1, 2, 3}
    assert groups.expert(RIGHT, 2) == groups.expert(RIGHT, 2)  # the choice of an episode
    assert {*experts(groups, 0 * RIGHT, 2, 20)} == {2}


def test_what_has_paid_is_played_again():
    groups = make()
    play(groups, RIGHT, 0, successes=9, episodes=10, expert=1)
    counts = np.bincount(experts(groups, RIGHT, 0, 60), minlength=4)
    assert counts[1] > 30


def test_the_seed_determines_the_choices():
    ours, again, other = (experts(make(seed), RIGHT, 0, 40) for seed in (7, 7, 3))
    assert ours == again != other


@pytest.mark.parametrize(
    ("there", "back", "joined"),
    [
        ((5, 10), (5, 10), True),
        ((3, 3), (3, 3), True),
        ((3, 3), (2, 3), False),  # two successes one way
        ((8, 10), (3, 20), True),  # half of 50 % of 20 are 5; less a deviation of 2.24, 2.76
        ((8, 10), (3, 22), False),  # half of 50 % of 22 are 5.5; less a deviation of 2.35, 3.15
        ((3, 22), (8, 10), False),
    ],
)
def test_two_groups_are_one_task_if_each_pays_after_the_demonstrations_of_the_other(
    there, back, joined
):
    """Each succeeds in half the episodes after its own; the expected numbers are by hand."""
    groups = make()
    play(groups, LEFT, 0, 10, 20, expert=0)
    play(groups, RIGHT, 1, 10, 20, expert=1)
    play(groups, RIGHT, 0, *there, expert=1)
    play(groups, LEFT, 1, *back, expert=0)
    assert groups.trials.same_task() == ((0, 1) if joined else None)


@pytest.mark.parametrize(
    ("seed", "solved", "by_chance"),
    [(0, 0.5, 0.05), (1, 0.5, 0.05), (2, 0.5, 0.05), *((seed, 0.2, 0.08) for seed in range(6))],
)
def test_only_groups_of_one_task_are_joined(seed, solved, by_chance):
    """An expert solves a share of the episodes of its task that begin on its side.

    It succeeds in others by chance. A joined group's expert knows both sides. Weak experts may not
    be joined by then.
    """
    groups, rng = make(seed), np.random.default_rng(seed)
    for _ in range(600):
        side, row = rng.integers(2), int(rng.integers(160))
        start = (LEFT, RIGHT)[side] + torch.from_numpy(rng.normal(size=2)).float()
        group = int(groups.lookup(EMBEDDINGS[row]).group)
        expert, fits = groups.expert(start, group)
        pays = {*EMBEDDINGS[groups.group == expert].argmax(-1).tolist()}
        paid = row // 80 * 2 + side in pays
        groups.end(group, expert, fits=fits, success=rng.random() < (solved if paid else by_chance))
    group = groups.lookup(EMBEDDINGS).group.view(4, 40)
    assert group.equal(group[:, :1].expand(4, 40))
    numbers = group[:, 0].tolist()
    assert not {*numbers[:2]} & {*numbers[2:]}
    if solved == 0.5:
        assert len({*numbers}) == 2


def test_counts_of_groups_that_are_no_more_are_forgotten():
    groups = make()
    for start, shown, episodes, expert in (
        (LEFT, 0, 20, 0), (RIGHT, 1, 20, 1), (RIGHT, 0, 10, 1), (LEFT, 1, 10, 0),
    ):  # fmt: skip
        play(groups, start, shown, episodes // 2, episodes, expert)
    assert groups.trials.same_task() == (0, 1)
    groups.end(2, 2, fits=True, success=False)  # the next episode that ends joins them
    (joined,) = {0, 1} & {*groups.numbers}
    assert groups.trials.same_task() is None
    for counts in (groups.trials.after_own, groups.trials.after_others):
        assert {*counts} | {expert for row in counts.values() for expert in row} <= {joined, 2, 3}
    assert groups.fits(RIGHT, joined) and groups.fits(LEFT, joined)
    before = groups.trials.state_dict()
    groups.end(1 - joined, joined, fits=False, success=True)
    assert groups.trials.state_dict() == before


def test_a_state_is_a_copy_and_restores_everything():
    groups, other = make(1), BehaviorGroups(4, seed=1)
    play(groups, RIGHT, 0, 5, 10, expert=1)
    saved = groups.state_dict()
    before = str(saved)
    other.load_state_dict(saved)
    assert experts(other, RIGHT, 0, 20) == experts(groups, RIGHT, 0, 20)
    assert str(other.state_dict()) == str(groups.state_dict()) != before == str(saved)
