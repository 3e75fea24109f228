"""Groups of behaviors: which node is of which group, and what they make of the shipped bank."""

import io
from dataclasses import asdict

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.shipped import default_weights, groups_config
from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.transforms import TaskSchedule


def adapt(groups, *inputs):
    """Adapts groups of numbers on a line; returns the group of each from before."""
    return [int(groups.adapt(torch.tensor([float(x)])).group) for x in inputs]


def group_of(groups, *inputs):
    return groups.lookup(torch.tensor([[float(x)] for x in inputs])).group.tolist()


def line(**options):
    return BehaviorGroups(1, **{"activity_threshold": 0.5, "activity_scale": 1.0, **options})


def test_until_the_first_input_all_is_group_0_and_nothing_is_known():
    groups = BehaviorGroups(2, batch_size=[3])
    match = groups.lookup(torch.rand(3, 4, 2))
    assert match.group.equal(torch.zeros(3, 4, dtype=torch.int64))
    assert not match.activity.any()
    assert groups.num_groups.tolist() == [1, 1, 1]
    assert groups(torch.rand(3, 2)).group.tolist() == [0, 0, 0]


def test_two_similar_inputs_are_of_one_group_and_two_others_of_two():
    similar, different = line(), line()
    assert adapt(similar, 0, 0.5) == [0, 0]  # exp(-0.5) is 0.61
    assert (int(similar.num_groups), int(similar.gwr.num_nodes)) == (1, 2)
    assert adapt(different, 0, 0.8) == [0, 0]  # exp(-0.8) is 0.45
    assert (int(different.num_groups), int(different.gwr.num_nodes)) == (2, 2)
    assert group_of(different, 0.1, 0.7) == [0, 1]


def test_a_node_made_by_something_new_opens_a_group_half_way_to_it():
    groups = line()
    adapt(groups, *[0, 0.2] * 8)
    weight = float(groups.gwr.lookup(torch.tensor([9.0])).embedding)
    assert adapt(groups, 9) == [0]
    assert int(groups.num_groups) == 2
    assert float(groups.gwr.lookup(torch.tensor([9.0])).embedding) == pytest.approx(
        (weight + 9) / 2
    )
    assert group_of(groups, 0, 0.2, 4, 9) == [0, 0, 1, 1]
    # It is drawn to what it matches, and what was new is no longer so.
    adapt(groups, *[9] * 60)
    match = groups.lookup(torch.tensor([[9.0], [0.1]]))
    assert match.group.tolist() == [int(groups.num_groups) - 1, 0]
    assert match.activity.min() > 0.5


def test_a_group_parts_from_that_of_its_best_match():
    groups = line()
    # 0 and 20 stand for two tasks; then something new on either side.
    adapt(groups, 0, 20, *[0, 20] * 12)
    assert group_of(groups, 0, 20) == [0, 1]
    adapt(groups, 30)
    adapt(groups, -8)
    assert int(groups.num_groups) == 4
    assert [groups.parent(0, number) for number in range(4)] == [0, 0, 1, 0]
    assert group_of(groups, 25, -4) == [2, 3]


@pytest.mark.parametrize(("most", "expected"), [(1, 1), (2, 2), (None, 4)])
def test_beyond_so_many_groups_a_node_joins_that_of_its_best_match(most, expected):
    groups = line(max_groups=most)
    adapt(groups, 0, 20, *[0, 20] * 12, 30, -8)
    assert int(groups.num_groups) == expected
    assert int(groups.gwr.num_nodes) == 4  # all the same
    known = {1: [0, 0, 0, 0], 2: [0, 1, 1, 0], None: [0, 1, 2, 3]}[most]
    assert group_of(groups, 0, 20, 25, -4) == known


@settings(max_examples=40)
@given(
    inputs=st.lists(st.floats(-6, 6, width=16), min_size=1, max_size=60),
    threshold=st.sampled_from([0.3, 0.5, 0.8]),
    habituation=st.sampled_from([0.15, 0.5, 1.0]),
    scale=st.sampled_from([0.25, 1.0, 4.0]),
)
def test_nodes_and_groups_are_those_of_the_rule(inputs, threshold, habituation, scale):
    """A plain GWR-B beside, of which it is noted by what each of its nodes was made."""
    options = {
        "activity_threshold": threshold,
        "habituation_threshold": habituation,
        "activity_scale": scale,
    }
    groups = line(**options)
    gwr = GWRB(1, init="data", max_age=2**62, **options)
    of_node, parents = [], [0]
    for x in inputs:
        phi, n_before = torch.tensor([x]), int(gwr.num_nodes)
        match = gwr.adapt(phi)
        found = groups.adapt(phi)
        group = of_node[int(match.node)] if of_node else 0
        assert int(found.group) == group
        assert found.activity.equal(match.activity)
        if int(gwr.num_nodes) > n_before:
            if n_before and float(match.activity) < threshold:
                of_node.append(len(parents))
                parents.append(group)
            else:
                of_node.append(group)
    assert int(groups.num_groups) == len(parents)
    assert [groups.parent(0, g) for g in range(len(parents))] == parents
    assert all(parent < group for group, parent in enumerate(parents) if group)
    probe = torch.linspace(-7, 7, 29).unsqueeze(-1)
    match = gwr.lookup(probe)
    assert groups.lookup(probe).group.tolist() == [of_node[n] for n in match.node.tolist()]
    # Nothing is forgotten: a group has a node for good.
    assert set(of_node) == set(range(len(parents)))


def test_networks_that_are_masked_out_stay_as_they_are_and_each_is_as_alone():
    inputs = torch.rand(40, 3, 2, generator=torch.Generator().manual_seed(0)) * 4
    masks = torch.rand(40, 3, generator=torch.Generator().manual_seed(1)) < 0.6
    options = {"activity_threshold": 0.6, "activity_scale": 1.0}
    together = BehaviorGroups(2, batch_size=[3], **options)
    alone = [BehaviorGroups(2, **options) for _ in range(3)]
    for phi, mask in zip(inputs, masks, strict=True):
        match = together.adapt(phi, mask)
        for i, (row, active) in enumerate(zip(phi, mask.tolist(), strict=True)):
            if not active:
                assert int(match.group[i]) == -1
                assert match.activity[i].isnan()
                continue
            own = alone[i].adapt(row)
            assert int(own.group) == int(match.group[i])
            assert own.activity.equal(match.activity[i])
    assert together.num_groups.tolist() == [int(groups.num_groups) for groups in alone]
    assert together.num_groups.min() > 2
    shown = torch.rand(3, 50, 2, generator=torch.Generator().manual_seed(2)) * 4
    match = together.lookup(shown)
    for i, groups in enumerate(alone):
        assert match.group[i].equal(groups.lookup(shown[i]).group)
        for number in range(int(groups.num_groups)):
            assert together.parent(i, number) == groups.parent(0, number)


def test_looking_up_changes_nothing():
    groups = line()
    adapt(groups, 0, 3)
    before = [part.clone() for part in groups.gwr.graph()]
    group_of(groups, 9, 12)
    assert int(groups.num_groups) == 2
    for now, then in zip(groups.gwr.graph(), before, strict=True):
        assert now.equal(then)


def test_saved_groups_continue_as_the_others():
    groups, restored = (line(batch_size=[2]) for _ in range(2))
    restored.adapt(torch.tensor([[7.0], [8.0]]))
    inputs = torch.rand(80, 2, 1, generator=torch.Generator().manual_seed(3)) * 12
    only_first = torch.tensor([True, False])
    for phi in inputs[:40]:
        groups.adapt(phi, only_first)  # so that one of them is still empty
    file = io.BytesIO()
    torch.save(groups.state_dict(), file)
    file.seek(0)
    restored.load_state_dict(torch.load(file, weights_only=True))
    assert restored.num_groups.equal(groups.num_groups)
    for phi in inputs[40:]:
        ours, theirs = groups.adapt(phi), restored.adapt(phi)
        assert ours.group.equal(theirs.group)
        assert ours.activity.equal(theirs.activity)
    assert restored.num_groups.equal(groups.num_groups)
    assert groups.num_groups.min() > 1
    for number in range(int(groups.num_groups[0])):
        assert groups.parent(0, number) == restored.parent(0, number)


def test_fewer_than_one_group_is_refused():
    with pytest.raises(ValueError, match="max_groups must be a whole number, at least 1; got 0"):
        BehaviorGroups(2, max_groups=0)


# ---- the shipped bank


@pytest.fixture(scope="module")
def shipped():
    return load_pretrained()[1]


@pytest.mark.parametrize("starts", [(0, 60, 120), (120, 0, 60), (0, 0, 0)])
def test_groups_of_nicos_demonstrations_are_each_of_one_task(shipped, starts):
    """In the order of a run, five seeds at once; labels are used for the draw and the count."""
    schedule, n_seeds = TaskSchedule(starts), 5
    n_groups = {3, 4, 5}
    seen, held_out = shipped.seen(), shipped.held_out()
    groups = BehaviorGroups(32, batch_size=[n_seeds], **asdict(groups_config(default_weights())))
    rows = [torch.nonzero(seen.task == task).flatten() for task in range(3)]
    generator = torch.Generator().manual_seed(0)
    for episode in range(200):
        presented = [task for task, start in enumerate(schedule.starts) if start <= episode]
        pick = torch.randint(len(presented), (n_seeds,), generator=generator).tolist()
        of_tasks = [rows[presented[place]] for place in pick]
        shown = [int(row[torch.randint(len(row), (), generator=generator)]) for row in of_tasks]
        groups.adapt(seen.embedding[shown])
    assert set(groups.num_groups.tolist()) <= n_groups
    match = groups.lookup(held_out.embedding.expand(n_seeds, -1, -1))
    for of_seed in match.group:
        tasks_of: dict[int, set[int]] = {}
        for task, group in zip(held_out.task.tolist(), of_seed.tolist(), strict=True):
            tasks_of.setdefault(group, set()).add(task)
        assert all(len(tasks) == 1 for tasks in tasks_of.values())
        assert set.union(*tasks_of.values()) == {0, 1, 2}


def test_a_batch_size_may_be_a_number():
    groups = BehaviorGroups(2, batch_size=2)
    groups.adapt(torch.zeros(2, 2))
    assert groups.lookup(torch.zeros(2, 2)).group.tolist() == [0, 0]
    assert groups.num_groups.tolist() == [1, 1]


def test_a_state_of_other_networks_is_refused_and_changes_nothing():
    groups = BehaviorGroups(2, batch_size=3, activity_scale=1.0)
    for phi in torch.eye(2)[[0, 1, 0]]:
        groups.adapt(10 * phi.expand(3, 2))
    before = groups.get_extra_state()
    with pytest.raises(ValueError, match="groups of 2 networks, this BehaviorGroups 3"):
        groups.set_extra_state(BehaviorGroups(2, batch_size=2).get_extra_state())
    assert groups.get_extra_state() == before


def grown():
    groups = BehaviorGroups(2, activity_threshold=0.5, activity_scale=1.0)
    for phi in 10 * torch.eye(2)[[0, 0, 0, 1, 1, 1, 0, 1]]:
        groups.adapt(phi)
    assert groups.num_groups == 2
    return groups


def test_groups_and_nodes_are_loaded_together_or_not_at_all():
    groups, other = grown(), BehaviorGroups(2)
    state = groups.state_dict()
    empty = other.state_dict()
    wrong = {**state, "gwr._extra_state": empty["gwr._extra_state"]}
    with pytest.raises(ValueError, match=r"groups of \[3\] nodes, but \[0\] nodes"):
        other.load_state_dict(wrong)
    assert other.get_extra_state() == empty["_extra_state"]
    three = BehaviorGroups(3)
    with pytest.raises(ValueError, match="features"):
        three.load_state_dict(state)
    assert three.num_groups == 1
    other.load_state_dict(state)
    assert other.lookup(torch.tensor([0.0, 10.0])).group == 1


@pytest.mark.parametrize("damage", [{"group": [[0, 7]]}, {"parent": [[0, 5]]}])
def test_a_state_that_names_a_missing_group_is_refused(damage):
    groups = grown()
    before = groups.get_extra_state()
    with pytest.raises(ValueError, match="a group is missing in the state"):
        groups.set_extra_state({**before, **damage})
    assert groups.get_extra_state() == before
