"""Who plays an episode, the clone or what critics choose: against plain lists of outcomes."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.algorithms.proposal_trials import ProposalTrials


def play(trials, outcomes, group=7, seed=0):
    """Play an episode for each outcome; return who played, True for the clone."""
    played = []
    for success in outcomes:
        played.append(trials.begin(seed, group))
        trials.end(seed, success, group=group)
    return played


@settings(max_examples=40)
@given(
    first=st.integers(0, 6),
    share=st.sampled_from([0.0, 0.1, 0.25, 0.4, 0.9]),
    n_episodes=st.integers(0, 150),
    rates=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    seed=st.integers(0, 99),
    restored=st.booleans(),
)
def test_the_clone_has_its_share_of_training_and_tests_until_the_choice_is_as_good(
    first, share, n_episodes, rates, seed, restored
):
    def make():
        return ProposalTrials(2, clone_episodes=first, clone_share=share)

    def rate(of_one):
        weight = 0.97 ** np.arange(len(of_one))[::-1]
        return weight @ of_one / weight.sum() if of_one else 0.0

    trials, rng = make(), np.random.default_rng(seed)
    outcomes, later, owed = {True: [], False: []}, 0, 0.0
    for number in range(n_episodes):
        better = trials.clone_is_better(1, 7)
        if len(outcomes[False]) < 20 or abs(rate(outcomes[True]) - rate(outcomes[False])) > 1e-9:
            expected = len(outcomes[False]) < 20 or rate(outcomes[False]) < rate(outcomes[True])
            assert better == expected
        alone = trials.begin(1, 7)
        assert trials.only_clone == [False, alone]
        assert alone or number >= first
        if number >= first:
            owed += max(0.5, share) if better else share
            later += alone
            assert later == pytest.approx(owed, abs=1)  # at any time
        outcomes[alone].append(rng.random() < rates[alone])
        trials.end(1, outcomes[alone][-1], group=7)
        if restored:
            state, trials = trials.state_dict(), make()
            trials.load_state_dict(state)
    assert trials.clone_is_better(0, 7) and trials.clone_is_better(1, 3)  # of others, nothing


def test_the_rules_by_hand():
    trials = ProposalTrials(1, clone_episodes=3, clone_share=0.25)
    # As long as the critics' choice has not played 20 episodes, the clone plays every second one.
    assert play(trials, [True] * 41) == [True] * 3 + [False, True] * 19
    assert trials.clone_is_better(0, 7)
    assert play(trials, [True]) == [False] and not trials.clone_is_better(0, 7)  # 20, and as good
    assert play(trials, [True] * 11) == [False, True] + [False, False, False, True] * 2 + [False]


def test_the_clone_plays_trials_as_long_as_it_is_better():
    trials = ProposalTrials(1, clone_episodes=2, clone_share=0.5)
    play(trials, [True] * 2)
    assert all(trials.begin(0, 7, trial=True) for _ in range(5))
    assert play(trials, [True] * 3) == [False, True, False]  # trials are not set off against it
    play(trials, [True] * 36)
    assert not trials.clone_is_better(0, 7)
    assert [trials.begin(0, 7, trial=True) for _ in range(3)] == [True, False, True]


def test_episodes_of_demonstrations_that_belong_to_another_group_do_not_count():
    """A new task's first episodes are played by an old group, and fail; then it has its own."""
    trials = ProposalTrials(1, clone_episodes=0, clone_share=0.5)
    for _ in range(60):  # demonstration 0 is of group 7
        trials.end(0, not trials.begin(0, 7), group=7, demonstration=0)
    assert not trials.clone_is_better(0, 7)
    record = copy.deepcopy(trials.state_dict()["groups"][0][7])
    for _ in range(60):  # of another group, which played: as many episodes, no outcomes
        trials.begin(0, 7)
        trials.end(0, False, group=4, demonstration=0)
    other = trials.state_dict()["groups"][0][7]
    assert other == {**record, "episodes": 120}
    for _ in range(60):  # demonstration 1 is thought to be of group 7
        trials.end(0, trials.begin(0, 7), group=7, demonstration=1)
    assert trials.clone_is_better(0, 7)
    trials.follow(0, [7, 8], [7, 8])  # it has got group 8
    assert not trials.clone_is_better(0, 7)
    assert trials.state_dict()["groups"][0][7] == {**record, "episodes": 180}
