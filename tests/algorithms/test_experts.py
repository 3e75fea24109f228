"""Experts: which groups are active, and that a group's networks are its own for good."""

import copy
import io
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from bgpo_trl.algorithms.experts import ActiveGroups, Experts
from bgpo_trl.algorithms.rl import RL, LearnerSpec, make_learner

every_rl = pytest.mark.parametrize("name", RL)
SEEDS = (3, 8)
PARENTS = {0: 0, 1: 0, 2: 1, 3: 1, 4: 3, 5: 4}


# ---- which groups are active


@settings(max_examples=60)
@given(
    n_slots=st.integers(1, 4),
    played=st.lists(st.integers(0, 6), max_size=40),
    n_rows=st.integers(0, 9),
    restored=st.booleans(),
)
def test_the_groups_played_last_are_active(n_slots, played, n_rows, restored):
    active, other, latest, slots = ActiveGroups(2, n_slots), ActiveGroups(2, n_slots), [], {}
    for group in played:
        slot = active.play(1, group)
        assert slots.setdefault(group, slot) == slot  # it keeps its slot while it is active
        latest = [*(g for g in latest if g != group), group][-n_slots:]
        slots = {g: slots[g] for g in latest}
        assert len(set(slots.values())) == len(slots)  # which is its own
        if restored:
            other.load_state_dict(active.state_dict())
            active, other = other, ActiveGroups(2, n_slots)
    expected = [-1] * n_slots
    for group, slot in slots.items():
        expected[slot] = group
    assert active.group.tolist() == [[-1] * n_slots, expected]  # the other seed has played none
    for group in range(7):
        assert active.slot(1, group) == slots.get(group)
    rows = active.rows(n_rows)
    assert rows[0].tolist() == [-1] * n_rows
    counts = [rows[1].tolist().count(group) for group in latest]
    if latest:
        assert sum(counts) == n_rows
        assert max(counts) - min(counts) <= 1


# ---- their networks


def make(name="ddpg", n_slots=2, seeds=SEEDS):
    config = replace(RL[name].config, hidden_sizes=(8,))
    spec = LearnerSpec(seeds, ["state"], 6, (0.0, 1.1), torch.device("cpu"), experts=range(n_slots))
    learner = make_learner(config, spec)
    return Experts(learner, ActiveGroups(len(seeds), n_slots), lambda seed, group: PARENTS[group])


def make_batch(n_slots, seed):
    generator = torch.Generator().manual_seed(seed)
    shape = (2, n_slots, 8)
    terminated = torch.rand(*shape, 1, generator=generator) < 0.2
    following = {"state": torch.randn(*shape, 6, generator=generator), "terminated": terminated}
    data = {"state": torch.randn(*shape, 6, generator=generator)}
    data |= {"next": {**following, "reward": terminated.float()}}
    data["action"] = torch.rand(*shape, 4, generator=generator) * 2 - 1
    return TensorDict(data, shape)


def learn(experts, seed):
    experts.learner.learn(make_batch(experts.active.group.shape[1], seed))


def tensors_of(experts, seed, slot):
    """Copies of all that makes up one expert: networks, targets, moments of Adam."""
    learner, shape = experts.learner, experts.active.group.shape
    tensors = {
        key: value
        for key, value in learner.loss.state_dict().items()
        if not key.endswith("_extra_state") and value.ndim > 1
    }
    if "log_alpha" in dict(learner.loss.named_parameters()):
        assert "log_alpha" in tensors
    for name, parameter in learner.loss.named_parameters():
        for moment in ("exp_avg", "exp_avg_sq"):
            value = learner.optimizer.state.get(parameter, {}).get(moment)
            tensors[f"{moment} of {name}"] = torch.zeros_like(parameter) if value is None else value
    for value in tensors.values():
        assert value.shape[:2] == shape
    return {key: value[seed, slot].clone() for key, value in tensors.items()}


def differing(ours, theirs):
    assert ours.keys() == theirs.keys()
    return {key for key, value in ours.items() if not value.equal(theirs[key])}


@every_rl
def test_what_is_put_aside_comes_back_as_it_was(name):
    """Six groups in two slots: whatever else was played and learned, bit for bit."""
    experts, left = make(name), [{}, {}]
    generator = torch.Generator().manual_seed(1)
    returned = 0
    for step in range(30):
        groups = torch.randint(6, (2,), generator=generator).tolist() if step else [0, 0]
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


@every_rl
def test_a_new_group_starts_from_the_one_it_parted_from_without_its_moments(name):
    experts = make(name)
    experts.play([0, 0])
    for step in range(4):
        learn(experts, step)
    first = [tensors_of(experts, seed, 0) for seed in range(2)]
    (slot, _) = experts.play([1, 0]).tolist()
    assert slot == 1
    child = tensors_of(experts, 0, slot)
    for key, value in child.items():
        if " of " in key:
            assert not value.any()
            assert first[0][key].any()
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
    assert all(" of " in key for key in differing(grandchild, parent))


def test_a_parent_that_is_put_aside_is_inherited_from_too():
    experts = make()
    for step, group in enumerate((0, 2, 3)):  # two slots: 0 is put aside
        experts.play([group, group])
        learn(experts, step)
    assert experts.active.slot(0, 0) is None
    parent = experts.actor_weights(0, 0)
    (slot, _) = experts.play([1, 3]).tolist()
    child = tensors_of(experts, 0, slot)
    for key, value in parent.items():
        assert child[f"actor_network_params.{key}"].equal(value)
    learn(experts, 9)  # it was not taken from the parent, but copied
    assert not differing(experts.actor_weights(0, 0), parent)
    assert differing(experts.actor_weights(0, 1), parent) == set(parent)


@every_rl
def test_tests_see_the_weights_of_a_group_wherever_they_are(name):
    experts = make(name)
    start = tensors_of(experts, 1, 0)
    for key, value in experts.actor_weights(1, 3).items():  # before anything was played
        assert value.equal(start[f"actor_network_params.{key}"])
    kept = {}
    for step, group in enumerate((0, 1, 2, 4)):
        (_, slot) = experts.play([0, group]).tolist()
        learn(experts, step)
        kept[group] = tensors_of(experts, 1, slot)
        for other in experts.active.group[1].tolist():
            if other >= 0:
                kept[other] = tensors_of(experts, 1, experts.active.slot(1, other))
    copies = {group: experts.actor_weights(1, group) for group in (*kept, 3, 5)}
    for group, like in {0: 0, 1: 1, 2: 2, 3: 1, 4: 4, 5: 4}.items():
        for key, value in copies[group].items():
            assert value.equal(kept[like][f"actor_network_params.{key}"]), (group, key)
    before = copy.deepcopy(copies)
    learn(experts, 20)
    for group, weights in copies.items():  # they are copies
        for key, value in weights.items():
            assert value.equal(before[group][key])


@every_rl
def test_an_update_is_of_the_same_size_however_many_groups_there_are(name):
    def sizes(experts):
        state = experts.learner.optimizer.state
        shapes = {k: v.shape for k, v in experts.learner.loss.state_dict().items()}
        return (
            shapes,
            len(state),
            [len(g["params"]) for g in experts.learner.optimizer.param_groups],
        )

    experts, few = make(name), make(name)
    for step in range(6):
        few.play([0, 0])
        learn(few, step)
    for step in range(6):
        experts.play([step, step])
        learn(experts, step)
    assert sizes(experts) == sizes(few)


@every_rl
def test_a_seed_of_a_batch_is_that_seed_alone(name):
    together, alone = make(name), make(name, seeds=SEEDS[1:])
    generator = torch.Generator().manual_seed(2)
    for step in range(30):
        first, second = torch.randint(6, (2,), generator=generator).tolist() if step else (0, 0)
        slots = together.play([first, second])
        assert alone.play([second]).tolist() == slots[1:].tolist()
        data = make_batch(2, step)
        together.learner.learn(data.clone())
        alone.learner.learn(data[1:].clone())
    for group in range(6):
        ours = together.actor_weights(1, group)
        for key, value in alone.actor_weights(0, group).items():
            torch.testing.assert_close(ours[key], value, rtol=1e-4, atol=1e-5)


@every_rl
@pytest.mark.parametrize("n_steps", [1, 13])
def test_restored_experts_go_on_bit_for_bit(name, n_steps):
    def play(experts, steps):
        for step in steps:
            experts.play([step % 5, step % 3])
            learn(experts, step)

    experts, restored = make(name), make(name, seeds=(0, 1))
    play(experts, range(n_steps))
    play(restored, range(4))
    file = io.BytesIO()
    torch.save({"learner": experts.learner.state_dict(), "experts": experts.state_dict()}, file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    restored.learner.load_state_dict(state["learner"])
    restored.load_state_dict(state["experts"])
    for one in (experts, restored):
        play(one, range(n_steps, n_steps + 12))
    assert restored.active.group.equal(experts.active.group)
    for seed in range(2):
        for slot in range(2):
            ours, theirs = (tensors_of(one, seed, slot) for one in (experts, restored))
            assert not differing(ours, theirs)
        for group in range(6):
            ours, theirs = (one.actor_weights(seed, group) for one in (experts, restored))
            assert not differing(ours, theirs)
