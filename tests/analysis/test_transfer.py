"""Forward transfer against numbers worked out by hand."""

import numpy as np

from bgpo_trl.analysis.transfer import expected_own_episodes, forward_transfer
from tests.analysis.runs import STARTS, make_run


def test_own_episodes_are_shared_among_the_presented_tasks():
    episodes = [5, 10, 20, 30]
    # Alone until 10, one of two until 20, then one of three.
    expected = {0: [5, 10, 15, 15 + 10 / 3], 1: [0, 0, 5, 5 + 10 / 3], 2: [0, 0, 0, 10 / 3]}
    for task, own in expected.items():
        np.testing.assert_allclose(expected_own_episodes(STARTS, task, episodes), own)
    from_the_start = expected_own_episodes((0, 0, 4), 1, episodes)
    np.testing.assert_allclose(from_the_start, [2 + 1 / 3, 4, 2 + 16 / 3, 2 + 26 / 3])


def test_forward_transfer_compares_equally_many_own_episodes():
    # Task b: 0.4 after 2.5 own episodes, 0.6 after 5; task c: 0 after 5/3, 0.4 after 10/3.
    b = (0.2 * 2.5 + 0.5 * 2.5) / 5
    c = 0.2 / 2
    # The reference plays each task in every third episode, all alike: 0.3 after 5/3, 0.6 after
    # 10/3, 0.6 for good. At 5 own episodes it has played 15.
    reference = make_run([[0.3] * 3, *[[0.6] * 3] * 5], (0, 0, 0), "cba")
    of_b = (0.15 * 5 / 3 + 0.45 * 5 / 3 + 0.6 * 5 / 3) / 5
    of_c = (0.15 + 0.45) / 2
    expected = [(b - of_b) / (1 - of_b), (c - of_c) / (1 - of_c)]
    np.testing.assert_allclose(forward_transfer(make_run(), reference), [expected] * 2)


def test_forward_transfer_finds_the_task_in_another_order():
    by_task = np.tile([[0.1, 0.5, 0.9]], (6, 1))
    ordered, turned = make_run(by_task, (0, 0, 0)), make_run(by_task[:, ::-1], (0, 0, 0), "cba")
    gains = [forward_transfer(make_run(), reference) for reference in (ordered, turned)]
    np.testing.assert_allclose(gains[0], gains[1])
