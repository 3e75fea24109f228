"""Experts: which groups are active, and that a group's networks are its own for good."""

import copy
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.algorithms.experts import ActiveGroups, Experts
from bgpo_trl.algorithms.rl import LearnerSpec, make_learner
from bgpo_trl.configs import SHOWN, RLConfig
from tests.algorithms.playing import make_batch

KINDS = {"actor": RLConfig(), "both": SHOWN}  # by their proposals
every_kind = pytest.mark.parametrize("name", KINDS)
SEEDS = (3, 8)
PARENTS = {0: 0, 1: 0, 2: 1, 3: 1, 4: 3, 5: 4}


# ---- which groups are active


@settings(max_examples=40)
@given(
    most=st.integers(1, 4),
    rest_after=st.integers(1, 9),
    played=st.lists(st.integers(0, 6), max_size=40),
    n_rows=st.integers(0, 9),
    restored=st.booleans(),
)
def test_the_groups_played_last_are_active(most, rest_after, played, n_rows, restored):
    active, other = (ActiveGroups(2, most, rest_after) for _ in range(2))
    slots, latest = {}, []
    for step, group in enumerate(played):
        active.play(1, group)
        within = played[max(0, step + 1 - rest_after) : step + 1][::-1]
        latest = list(dict.fromkeys(within))[:most]
        now = active.groups[1]
        assert sorted(now) == sorted(latest)
        if [*slots] and {*slots} <= {*now}:  # without a rest, all keep their slots
            assert all(now.index(group) == slot for group, slot in slots.items())
        slots = {group: slot for slot, group in enumerate(now)}
        if restored:
            other.load_state_dict(active.state_dict())
            active, other = other, ActiveGroups(2, most, rest_after)
    width = max(1, len(latest))
    assert active.group.tolist() == [[-1] * width, [*slots] or [-1]]  # the other has played none
    rows = active.rows(n_rows)
    assert rows[0].tolist() == [-1] * n_rows
    counts = [rows[1].tolist().count(group) for group in latest]
    if latest:
        assert sum(counts) == n_rows
        assert max(counts) - min(counts) <= 1


# ---- their networks


def make(name="actor", most=2, seeds=SEEDS, rest_after=99):
    config = replace(KINDS[name], hidden_sizes=(8,))
    spec = LearnerSpec(seeds, ["state"], 6, (0.0, 1.1), torch.device("cpu"))
    return Experts(
        make_learner(config, spec),
        ActiveGroups(len(seeds), most, rest_after),
        lambda seed, group: PARENTS[group],
    )


def learn(experts, seed, rows=slice(None)):
    """An update in which what a group sees depends on nothing but the seed and the group."""
    group = experts.active.group
    data = make_batch(2, 6, 8, seed=seed)[rows]
    batch = data[torch.arange(len(group)).unsqueeze(1), group.clamp(min=0)].clone()
    weight = (group >= 0).float().unsqueeze(-1).expand(-1, -1, 8)
    batch["priority_weight"] = batch["imitation", "priority_weight"] = weight
    experts.learner.learn(batch)


def tensors_of(experts, seed, slot):
    """Copies of all that makes up one expert: networks, targets, moments of Adam."""
    loss, optimizer = experts.learner.loss, experts.learner.optimizer
    tensors = {
        key: value
        for key, value in loss.state_dict().items()
        if not key.endswith("_extra_state") and value.ndim > 1
    }
    for name, parameter in loss.named_parameters():
        assert name in tensors
        for moment in ("exp_avg", "exp_avg_sq"):
            value = optimizer.state.get(parameter, {}).get(moment)
            tensors[f"{moment} of {name}"] = torch.zeros_like(parameter) if value is None else value
    for value in tensors.values():
        assert value.shape[:2] == experts.active.group.shape
    return {key: value[seed, slot].clone() for key, value in tensors.items()}


def differing(ours, theirs):
    assert ours.keys() == theirs.keys()
    return {key for key, value in ours.items() if not value.equal(theirs[key])}


def policy_of(experts, seed, group):
    """Copies of the weights with which tests of a group are played."""
    return experts.learner.expert_weights(experts.find(seed, group))


def assert_policy(experts, seed, group, tensors):
    """Assert that tests of a group are played by the networks of these `tensors_of` an expert."""
    of_policy = policy_of(experts, seed, group)
    assert not of_policy.pop("only_clone", None)
    for part, source in experts.learner.sources.items():
        start = f"{part}." if part else ""
        own = [key for key in of_policy if key.startswith(start)]
        assert own
        for key in own:
            value = of_policy.pop(key)
            assert value.equal(tensors[f"{source}.{key.removeprefix(start)}"]), (group, key)
    assert not of_policy


@every_kind
def test_before_an_ancestor_has_played_an_expert_is_the_initial_one(name):
    experts = make(name)
    initial = tensors_of(experts, 0, 0)
    experts.play([2, 0])
    learn(experts, 1)
    assert differing(tensors_of(experts, 0, 0), initial)
    for group in (0, 1):
        assert_policy(experts, 0, group, initial)
    saved = make(name)
    saved.load_state_dict(experts.state_dict())
    assert_policy(saved, 0, 1, initial)
    slots = experts.play([1, 0])
    assert not differing(tensors_of(experts, 0, int(slots[0])), initial)


@every_kind
def test_what_is_put_aside_comes_back_as_it_was(name):
    """Six groups in two slots, of which some end: whatever else was learned, bit for bit."""
    experts, left = make(name), [{}, {}]
    generator = torch.Generator().manual_seed(1)
    returned = 0
    for step in range(30):
        groups = torch.randint(6, (2,), generator=generator).tolist() if step else [0, 0]
        if step % 7 == 6:
            ended = experts.active.groups[0][0]
            experts.rest(0, ended)
            assert ended not in experts.active.groups[0]
            assert_policy(experts, 0, ended, left[0][ended])
        slots = experts.play(groups).tolist()
        for seed, (group, slot) in enumerate(zip(groups, slots, strict=True)):
            assert experts.active.group[seed, slot] == group
            if group in left[seed]:
                assert not differing(tensors_of(experts, seed, slot), left[seed][group])
                returned += 1
        learn(experts, step)
        for seed, of_seed in enumerate(experts.active.group.tolist()):
            for slot, group in enumerate(of_seed):
                if group >= 0:
                    left[seed][group] = tensors_of(experts, seed, slot)
    assert [sorted(of_seed) for of_seed in left] == [[*range(6)]] * 2
    assert returned > 30


@every_kind
def test_a_new_group_starts_from_the_one_it_parted_from_but_optimizes_and_imitates_anew(name):
    def anew(key: str) -> bool:
        return " of " in key or key == "n_imitated"

    experts = make(name)
    experts.play([0, 0])
    for step in range(4):
        learn(experts, step)
    first = [tensors_of(experts, seed, 0) for seed in range(2)]
    (slot, _) = experts.play([1, 0]).tolist()
    assert slot == 1
    child = tensors_of(experts, 0, slot)
    for key, value in child.items():
        if anew(key):
            assert not value.any()
            assert first[0][key].any() or (name, key) == ("actor", "n_imitated")
        else:
            assert value.equal(first[0][key]), key
    for seed in range(2):
        assert not differing(tensors_of(experts, seed, 0), first[seed])
    # Group 4 parted from 3, which was never played, as 3 parted from 1.
    learn(experts, 9)
    parent = tensors_of(experts, 0, 1)
    (slot, _) = experts.play([4, 0]).tolist()
    assert slot == 0
    grandchild = tensors_of(experts, 0, 0)
    assert all(map(anew, differing(grandchild, parent)))


@every_kind
def test_tests_see_the_weights_of_a_group_wherever_they_are(name):
    experts = make(name)
    start = tensors_of(experts, 1, 0)
    assert_policy(experts, 1, 3, start)  # before anything was played
    kept = {}
    for step, group in enumerate((0, 1, 2, 4)):
        experts.play([0, group])
        learn(experts, step)
        for slot, active in enumerate(experts.active.groups[1]):
            kept[active] = tensors_of(experts, 1, slot)
    copies = {group: policy_of(experts, 1, group) for group in range(6)}
    for group, like in {0: 0, 1: 1, 2: 2, 3: 1, 4: 4, 5: 4}.items():
        assert_policy(experts, 1, group, kept[like])
    before = copy.deepcopy(copies)
    learn(experts, 20)
    assert not any(differing(copies[group], before[group]) for group in copies)  # they are copies


def test_a_stack_is_as_wide_as_groups_are_active():
    experts = make(most=3, rest_after=4)
    widths = []
    for step, groups in enumerate([(0, 0), (0, 1), (2, 1), (3, 1), (4, 1), *[(4, 1)] * 3]):
        experts.play(groups)
        learn(experts, step)
        widths.append(experts.learner.loss.batch_size[1])
        assert {p.shape[:2] for p in experts.learner.loss.parameters()} == {(2, widths[-1])}
        for state in experts.learner.optimizer.state.values():
            assert state["exp_avg"].shape[:2] == (2, widths[-1])
            assert int(state["step"]) == step + 1
    assert widths == [1, 2, 2, 3, 3, 3, 2, 1]
