"""Task inference, counted by hand on networks with nodes at known places."""

import pytest
import torch

from bgpo_trl.analysis.task_inference import (
    group_purity,
    majority_task,
    match_counts,
    task_inference_accuracy,
)
from bgpo_trl.configs.runs import PAPER_TASKS
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB

PLACES = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 9.0]])


def network(*nodes, batch_size=()):
    """Nodes at the given positions of PLACES, in this order."""
    gwr = GWRB(2, batch_size=batch_size)
    state = gwr.get_extra_state()
    for index, positions in enumerate(nodes):
        n = len(positions)
        state[index] |= {
            "weights": PLACES[list(positions)],
            "habituation": torch.ones(n, dtype=torch.float64),
            "edges": torch.tensor([[i, i + 1] for i in range(n - 1)]),
            "ages": torch.zeros(n - 1, dtype=torch.int64),
            "node": torch.arange(n) * 3 + 1,  # some in between were removed
            "next_node": 99,
        }
    gwr.set_extra_state(state)
    return gwr


def bank(*demonstrations):
    """Demonstrations as (position in PLACES, task), a little off their place."""
    place, task = map(torch.tensor, zip(*demonstrations, strict=True))
    return DemonstrationBank(
        PLACES[place] + 0.1, task, torch.ones(len(task), dtype=torch.bool), PAPER_TASKS
    )


SEEN = bank((0, 0), (0, 0), (0, 1), (1, 1), (1, 1), (1, 0))


def test_matches_are_counted_by_network_node_and_task():
    assert match_counts(network((0, 1, 2)), SEEN).tolist() == [[2, 1, 0], [1, 2, 0], [0, 0, 0]]
    gwr = network((0, 1, 2), (2, 1), batch_size=[2])
    assert match_counts(gwr, SEEN).tolist() == [
        [[2, 1, 0], [1, 2, 0], [0, 0, 0]],
        [[0, 0, 0], [3, 3, 0], [0, 0, 0]],
    ]


def test_the_majority_task_without_matches_is_none_and_of_a_tie_the_first():
    counts = torch.tensor([[[2, 1], [1, 3], [0, 0]], [[2, 2], [0, 1], [4, 0]]])
    assert majority_task(counts).tolist() == [[0, 1, -1], [1, 1, 0]]  # shares, not counts
    assert majority_task(torch.tensor([[1, 1], [2, 2]])).tolist() == [0, 0]


@pytest.mark.parametrize(
    ("tested", "accuracy"),
    [
        ([(0, 0), (1, 1)], 1.0),
        ([(0, 1), (1, 0)], 0.0),
        ([(0, 0), (0, 0), (0, 1), (1, 1)], 0.75),
        ([(0, 0), (2, 0)], 0.5),  # a node that nothing seen has matched tells no task
    ],
)
def test_accuracy_is_the_share_of_demonstrations_whose_node_has_their_task(tested, accuracy):
    gwr = network((0, 1, 2))
    assert task_inference_accuracy(gwr, SEEN, bank(*tested)).tolist() == accuracy


def test_tasks_count_equally_whatever_their_number_of_demonstrations():
    # One group for two tasks, of which one has nine times as many demonstrations.
    groups = BehaviorGroups(2)
    for _ in range(3):
        groups.adapt(PLACES[0])
    shown = bank(*[(0, 0)] * 9, (1, 1))
    assert group_purity(groups, shown) == 0.5
    gwr = network((0, 1))
    both = bank(*[(0, 0)] * 9, (0, 1))
    assert task_inference_accuracy(gwr, both, both).item() == 0.5
