"""The buffer against a plain list of transitions, and each seed of a stack against itself alone."""

import io
import resource
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from bgpo_trl.data.replay import ReplayBuffer


def generators(n: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(n)]


def transition(value: float, *shape: int) -> TensorDict:
    """A transition of each seed whose every entry says ``value`` and which seed it is."""
    seed = torch.arange(torch.Size(shape).numel()).view(shape)
    number = (value + seed / 100).unsqueeze(-1)
    next_data = {"latent": number + torch.zeros(3), "terminated": seed.unsqueeze(-1) % 2 == 1}
    return TensorDict({"latent": number, "task": seed, "next": next_data}, shape)


@settings(deadline=None, max_examples=40)
@given(
    capacity=st.integers(1, 7),
    writes=st.lists(
        st.tuples(st.integers(1, 7), st.lists(st.booleans(), min_size=21, max_size=21)),
        min_size=1,
        max_size=6,
    ),
    masked=st.booleans(),
)
def test_holds_the_last_transitions_of_each_seed(capacity, writes, masked):
    n_seeds = 3
    replay = ReplayBuffer(capacity, batch_size=20, generator=generators(n_seeds))
    rings: list[list[float]] = [[] for _ in range(n_seeds)]
    added, value = [0] * n_seeds, 0.0
    for n_steps, choices in writes:
        n_steps = min(n_steps, capacity)
        steps = [transition(value + step, n_seeds) for step in range(n_steps)]
        mask = torch.tensor(choices).view(7, n_seeds)[:n_steps]
        if not masked:
            mask = torch.ones_like(mask)
        if n_steps == 1:
            replay.add(steps[0], mask[0] if masked else None)
        else:
            replay.extend(torch.stack(steps), mask if masked else None)
        for step, seed in mask.nonzero().tolist():
            ring, position = rings[seed], added[seed] % capacity
            ring[position : position + 1] = [value + step + seed / 100]
            added[seed] += 1
        value += n_steps
    assert replay.sizes.tolist() == [len(ring) for ring in rings]
    assert len(replay) == min(len(ring) for ring in rings)
    if not len(replay):
        with pytest.raises(ValueError, match="every seed needs a transition"):
            replay.sample()
        return
    batch = replay.sample()
    assert batch.batch_size == (n_seeds, 20)
    for seed, (ring, generator) in enumerate(zip(rings, generators(n_seeds), strict=True)):
        index = torch.randint(len(ring), (20,), generator=generator)
        expected = torch.tensor(ring)[index].unsqueeze(-1)
        torch.testing.assert_close(batch["latent"][seed], expected)
        torch.testing.assert_close(batch["next", "latent"][seed], expected.expand(-1, 3))
        assert (batch["task"][seed] == seed).all()
        assert (batch["next", "terminated"][seed] == (seed % 2 == 1)).all()


def test_seed_of_a_stack_is_that_seed_alone():
    stacked = ReplayBuffer(5, batch_size=16, generator=generators(3))
    alone = [ReplayBuffer(5, batch_size=16, generator=g) for g in generators(3)]
    for step in range(8):
        data = transition(step, 3)
        stacked.add(data)
        for replay, row in zip(alone, data.unbind(0), strict=True):
            replay.add(row)
        batches = [replay.sample() for replay in alone]
        assert batches[0].batch_size == (16,)
        assert (stacked.sample() == torch.stack(batches)).all()


def test_every_transition_is_drawn_equally_often():
    replay = ReplayBuffer(10, batch_size=1, generator=generators(2))
    replay.extend(torch.stack([transition(step, 2) for step in range(10)]))
    drawn = replay.sample(20_000)["latent"].squeeze(-1)
    for seed in range(2):
        count = drawn[seed].round().long().bincount(minlength=10)
        assert ((count - 2000).abs() < 5 * 2000**0.5).all()
    assert (drawn[0].round() != drawn[1].round()).any()


def test_samples_share_nothing_with_the_buffer():
    replay = ReplayBuffer(4, batch_size=4, generator=torch.Generator())
    data = TensorDict({"action": torch.ones(2, requires_grad=True)}, [])
    replay.add(data)
    data["action"].data.zero_()
    replay.sample()["action"].zero_()
    batch = replay.sample()
    assert (batch["action"] == 1).all()
    assert not batch["action"].requires_grad


def test_only_chosen_entries_are_stored():
    keys = ["latent", ("next", "terminated")]
    replay = ReplayBuffer(4, generator=generators(2), keys=keys)
    replay.add(transition(0, 2))
    assert set(replay.sample().keys(True, True)) == set(keys)
    whole = ReplayBuffer(4, generator=generators(2), keys=["next"])
    whole.add(transition(0, 2))
    assert set(whole.sample().keys(True, True)) == {("next", "latent"), ("next", "terminated")}


def restored_by_torch(replay: ReplayBuffer, restored: ReplayBuffer) -> int:
    """Restores one buffer from another by way of a file; returns its size."""
    file = io.BytesIO()
    torch.save(replay.state_dict(), file)
    file.seek(0)
    restored.load_state_dict(torch.load(file, weights_only=True))
    return len(file.getvalue())


@pytest.mark.parametrize("capacity", [3, 100_000])
def test_a_restored_buffer_continues_as_the_saved_one(capacity):
    replay = ReplayBuffer(capacity, batch_size=8, generator=generators(2))
    for n_steps in (2, 3):
        for step in range(n_steps):
            replay.add(transition(step, 2))
        replay.sample()
        restored = ReplayBuffer(capacity, batch_size=8, generator=generators(2))
        restored.add(transition(99, 2))
        assert restored_by_torch(replay, restored) < 100_000
    assert restored.sizes.tolist() == replay.sizes.tolist()
    for step in range(3):
        assert (restored.sample() == replay.sample()).all()
        for buffer in (restored, replay):
            buffer.add(transition(10 + step, 2))
    assert (restored.sample() == replay.sample()).all()


def test_what_was_never_stored_is_saved_as_zeros(monkeypatch):
    """Not as what happened to lie in memory, which differs from run to run."""
    monkeypatch.setattr(torch, "empty", lambda *shape, **kw: torch.ones(*shape, **kw))
    replay = ReplayBuffer(9, batch_size=4, generator=generators(3))
    for step in range(5):
        replay.add(transition(7 + step, 3), torch.tensor([step < 2, step < 5, step < 4]))
    saved = TensorDict(replay.state_dict()["rows"], [15])
    assert saved["latent"].shape == (15, 1)
    stored = saved["latent"].view(5, 3).T
    for seed, size in enumerate((2, 5, 4)):
        torch.testing.assert_close(stored[seed, :size], 7 + torch.arange(size) + seed / 100)
        for rows in saved.view(5, 3)[size:, seed].values(True, True):
            assert (rows == 0).all()


def test_an_empty_buffer_can_be_saved():
    replay = ReplayBuffer(3, generator=generators(2))
    restored = ReplayBuffer(3, generator=generators(2))
    restored.add(transition(0, 2))
    restored_by_torch(replay, restored)
    assert len(restored) == 0
    restored.add(TensorDict({"other": torch.zeros(2, 1)}, [2]))


def test_capacity_costs_no_memory_until_it_is_filled():
    unit = 1 if sys.platform == "darwin" else 1024
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    replay = ReplayBuffer(1_000_000, generator=generators(10))
    replay.add(TensorDict({"latent": torch.zeros(10, 128)}, [10]))
    replay.sample()
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert growth * unit < 100e6  # the whole is 5 GB


BAD = {
    "batch size": (transition(0, 3), None),
    "lacks": (transition(0, 2).exclude("latent"), None),
    "latent.*as stored before": (transition(0, 2).set("latent", torch.zeros(2, 5)), None),
    "task.*int64": (transition(0, 2).set("task", torch.zeros(2)), None),
    "mask": (transition(0, 2), torch.ones(2)),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_transitions_change_nothing(message):
    replay = ReplayBuffer(2, batch_size=16, generator=generators(2))
    for step in range(2):
        replay.add(transition(step, 2))
    before = replay.state_dict()
    with pytest.raises(ValueError, match=message):
        replay.add(*BAD[message])
    after = replay.state_dict()
    assert (TensorDict(after) == TensorDict(before)).all()


def test_steps_are_taken_as_they_were_stored():
    """Each seed stores at its own pace: the third stored every second of nine, six are kept."""
    replay = ReplayBuffer(6, generator=generators(3))
    stored = [[], [], []]
    for step in range(9):
        mask = torch.tensor([True, step < 4, step % 2 == 0])
        replay.add(transition(step, 3), mask)
        for seed in mask.nonzero().flatten().tolist():
            stored[seed].append(step)
    assert replay.n_added.tolist() == [9, 4, 5]
    assert replay.oldest.tolist() == [3, 0, 0]
    steps = torch.tensor([[3, 8, 8, 5], [0, 3, 2, 1], [4, 0, 0, 2]])
    taken = replay.take(steps)
    assert taken.batch_size == (3, 4)
    for seed in range(3):
        for row, step in enumerate(steps[seed].tolist()):
            assert (taken[seed, row] == transition(stored[seed][step], 3)[seed]).all()
    some = replay.take(steps[[2, 0]], ["latent"], seeds=[2, 0])
    assert list(some.keys()) == ["latent"]
    assert some["latent"].equal(taken["latent"][[2, 0]])


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="at least 1"):
        ReplayBuffer(0, generator=torch.Generator())
    with pytest.raises(ValueError, match="number of generators"):
        ReplayBuffer(3, generator=[])
    with pytest.raises(ValueError, match=r"lacks \['reward'\]"):
        ReplayBuffer(3, generator=generators(2), keys=["reward"]).add(transition(0, 2))
    with pytest.raises(ValueError, match="1 <= T <= 3"):
        ReplayBuffer(3, generator=generators(2)).extend(torch.stack([transition(0, 2)] * 4))
    saved, other = (
        ReplayBuffer(4, generator=generators(2)),
        ReplayBuffer(3, generator=generators(2)),
    )
    other.add(transition(7, 2))
    with pytest.raises(ValueError, match="capacity 4 and 2 seeds"):
        other.load_state_dict(saved.state_dict())
    assert len(other) == 1
