"""The buffer against a plain list of transitions, and each seed of a stack against itself alone."""

import io
import resource
import sys
from itertools import chain
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from bgpo_trl.replay import ReplayBuffer
from bgpo_trl.task_replay import TaskReplay


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


def states(replay: ReplayBuffer) -> list[torch.Tensor]:
    return [generator.get_state() for generator in replay.generators]


@pytest.mark.parametrize("seeds", [[0], [2, 0], [3, 1, 2]])
@pytest.mark.parametrize("batch_size", [None, 5])
def test_some_seeds_draw_what_they_would_draw_with_all(seeds, batch_size):
    some, every = (ReplayBuffer(6, batch_size=16, generator=generators(4)) for _ in range(2))
    for step in range(8):
        mask = torch.tensor([True, step % 2 == 0, step < 7, step == 3])
        for replay in (some, every):
            replay.add(transition(step, 4), mask)
    before = states(some)
    drawn, whole = some.sample(batch_size, seeds=seeds), every.sample(batch_size)
    assert drawn.batch_size == (len(seeds), batch_size or 16)
    assert (drawn == whole[seeds]).all()
    for seed in range(4):  # and only they have drawn
        expected = states(every) if seed in seeds else before
        assert states(some)[seed].equal(expected[seed])
    # They go on as they would have.
    rest = [seed for seed in range(4) if seed not in seeds]
    some.sample(batch_size, seeds=rest)
    assert (some.sample() == every.sample()).all()


def test_seeds_without_transitions_are_in_the_way_of_none_but_themselves():
    replay = ReplayBuffer(4, batch_size=3, generator=generators(3))
    replay.add(transition(5, 3), torch.tensor([True, False, True]))
    drawn = replay.sample(seeds=[2, 0])
    torch.testing.assert_close(drawn["latent"].squeeze(-1)[:, 0], torch.tensor([5.02, 5.00]))
    for seeds in (None, [1], [0, 1]):
        with pytest.raises(ValueError, match="every seed needs a transition"):
            replay.sample(seeds=seeds)


@pytest.mark.parametrize("seeds", [None, [2, 0]])
def test_given_generators_draw_in_place_of_the_buffers_own(seeds):
    replay = ReplayBuffer(20, batch_size=16, generator=generators(3))
    replay.extend(torch.stack([transition(step, 3) for step in range(20)]))
    before, positions = states(replay), [0, 1, 2] if seeds is None else seeds
    given = [torch.Generator().manual_seed(90 + i) for i in range(len(positions))]
    drawn = replay.sample(7, seeds=seeds, generator=given)
    for row, seed in enumerate(positions):
        index = torch.randint(20, (7,), generator=torch.Generator().manual_seed(90 + row))
        torch.testing.assert_close(drawn["latent"][row], (index + seed / 100).unsqueeze(-1))
    for state, old in zip(states(replay), before, strict=True):
        assert state.equal(old)
    with pytest.raises(ValueError, match="zip"):
        replay.sample(seeds=seeds, generator=given[1:])


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


def saved_by_torch(replay: ReplayBuffer, restored: ReplayBuffer, path: Path) -> int:
    file = io.BytesIO()
    torch.save(replay.state_dict(), file)
    file.seek(0)
    restored.load_state_dict(torch.load(file, weights_only=True))
    return len(file.getvalue())


def saved_to_directory(replay: ReplayBuffer, restored: ReplayBuffer, path: Path) -> int:
    replay.dumps(path)
    restored.loads(path)
    return sum(file.stat().st_size for file in path.rglob("*"))


@pytest.mark.parametrize("save", [saved_by_torch, saved_to_directory])
@pytest.mark.parametrize("capacity", [3, 100_000])
def test_a_restored_buffer_continues_as_the_saved_one(save, capacity, tmp_path):
    replay = ReplayBuffer(capacity, batch_size=8, generator=generators(2))
    for n_steps in (2, 3):  # twice into the same directory, the second time more
        for step in range(n_steps):
            replay.add(transition(step, 2))
        replay.sample()
        restored = ReplayBuffer(capacity, batch_size=8, generator=generators(2))
        restored.add(transition(99, 2))
        assert save(replay, restored, tmp_path) < 100_000
    for file in tmp_path.rglob("*.memmap"):
        file.unlink()
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


def test_an_empty_buffer_can_be_saved(tmp_path):
    replay = ReplayBuffer(3, generator=generators(2))
    restored = ReplayBuffer(3, generator=generators(2))
    restored.add(transition(0, 2))
    saved_to_directory(replay, restored, tmp_path)
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


N_SEEDS, N_TASKS = 2, 3


def task_generators(n_seeds: int = N_SEEDS) -> list[list[torch.Generator]]:
    return [generators(n_seeds * N_TASKS)[i * N_TASKS : (i + 1) * N_TASKS] for i in range(n_seeds)]


def make_task_replay(capacity=5, batch_size=3, generator=None) -> TaskReplay:
    keys = ["latent", ("next", "terminated")]
    generator = generator or task_generators()
    return TaskReplay(capacity, batch_size=batch_size, generator=generator, keys=keys)


def of_tasks(value: float, *tasks: int) -> TensorDict:
    """A transition of each seed with its task."""
    return transition(value, len(tasks)).set("task", torch.tensor(tasks))


@settings(deadline=None, max_examples=40)
@given(
    capacity=st.integers(3, 7),
    played=st.lists(
        st.tuples(st.integers(0, N_TASKS - 1), st.integers(0, N_TASKS - 1)), max_size=25
    ),
    batch_size=st.integers(1, 3),
    n_drawn=st.sampled_from([None, 1, 9]),
    given_generators=st.booleans(),
)
def test_each_task_of_each_seed_has_a_ring_of_its_own(
    capacity, played, batch_size, n_drawn, given_generators
):
    replay = make_task_replay(capacity, batch_size)
    rings = [[[] for _ in range(N_TASKS)] for _ in range(N_SEEDS)]
    for value, tasks in enumerate(played):
        replay.add(of_tasks(value, *tasks))
        for seed, task in enumerate(tasks):
            rings[seed][task].append(value + seed / 100)
    sizes = torch.tensor([[min(len(ring), capacity) for ring in of_seed] for of_seed in rings])
    ready = sizes >= batch_size
    assert replay.sizes.equal(sizes)
    assert replay.ready.equal(ready)
    assert len(replay) == sizes.sum(-1).min()
    if not ready.any():
        with pytest.raises(ValueError, match="no task fills a batch yet"):
            replay.sample(n_drawn)
        return

    given = [torch.Generator().manual_seed(90 + i) for i in range(N_SEEDS * N_TASKS)]
    batch = replay.sample(n_drawn, generator=given if given_generators else None)
    n_drawn = n_drawn or batch_size
    assert batch.batch_size == (N_SEEDS, N_TASKS, n_drawn)
    assert set(batch.keys(True, True)) == {"latent", ("next", "terminated"), "priority_weight"}
    expected = ready.float().unsqueeze(-1).expand(-1, -1, n_drawn)
    assert batch["priority_weight"].equal(expected)
    for seed in range(N_SEEDS):
        for task, ring in enumerate(rings[seed]):
            drawn, position = batch[seed, task], seed * N_TASKS + task
            if not ready[seed, task]:
                for value in drawn.values(True, True):
                    assert not value.any()
                continue
            kept: list[float] = []
            for number, value in enumerate(ring):
                kept[number % capacity : number % capacity + 1] = [value]
            seed_of_stream = 90 + position if given_generators else position
            stream = torch.Generator().manual_seed(seed_of_stream)
            index = torch.randint(len(kept), (n_drawn,), generator=stream)
            torch.testing.assert_close(drawn["latent"].squeeze(-1), torch.tensor(kept)[index])
            assert (drawn["next", "terminated"] == (seed == 1)).all()


def fill(*replays: TaskReplay, n_steps: int = 12, first: int = 0) -> None:
    """Adds transitions of changing tasks; the third task of the second seed has none."""
    for step in range(first, first + n_steps):
        for replay in replays:
            replay.add(of_tasks(step, (0, 1, 0, 2)[step % 4], step % 2))


def test_tasks_that_do_not_fill_a_batch_draw_nothing():
    streams = task_generators()
    replay = make_task_replay(batch_size=4, generator=streams)
    fill(replay, n_steps=6)
    assert replay.sizes.tolist() == [[3, 2, 1], [3, 3, 0]]
    replay.add(of_tasks(9, 0, 2))
    replay.sample()
    drew = [
        not stream.get_state().equal(untouched.get_state())
        for stream, untouched in zip(chain(*streams), chain(*task_generators()), strict=True)
    ]
    assert drew == [True, False, False, False, False, False]


def test_enough_transitions_fill_a_batch_of_a_task_whichever_they_are_of():
    replay = make_task_replay(capacity=9, batch_size=3)
    assert replay.enough == 7
    for step in range(6):  # as evenly as can be
        replay.add(of_tasks(step, step % 3, 0))
    assert not replay.ready[0].any()
    replay.add(of_tasks(6, 1, 0))
    assert len(replay) == replay.enough
    assert replay.ready.any(-1).all()


def test_a_seed_in_a_batch_of_task_replays_is_that_seed_alone():
    together = make_task_replay(generator=task_generators(2))
    alone = [make_task_replay(generator=[streams]) for streams in task_generators(2)]
    for step in range(20):
        data = of_tasks(step, (0, 1, 0, 2)[step % 4], step % 2)
        together.add(data)
        for seed, replay in enumerate(alone):
            replay.add(data[seed : seed + 1])
        for seed, replay in enumerate(alone):
            assert replay.sizes[0].equal(together.sizes[seed])
        if all(replay.ready.any() for replay in alone):
            drawn = together.sample()
            for seed, replay in enumerate(alone):
                assert (replay.sample()[0] == drawn[seed]).all()
    assert together.ready.tolist() == [[True, True, True], [True, True, False]]


def test_tasks_of_a_seed_are_drawn_in_the_order_asked_for():
    asked, reference = make_task_replay(), make_task_replay()
    fill(asked, reference)
    drawn = asked.sample_seed(0, [2, 0], 8)
    assert set(drawn.keys(True, True)) == {"latent", ("next", "terminated")}
    for row, task in enumerate((2, 0)):
        expected = reference.sample_seed(0, [task], 8)
        assert expected.batch_size == (1, 8)
        assert (drawn[row] == expected[0]).all()
    steps = drawn["latent"].squeeze(-1).round().long()
    assert (steps[0] % 4 == 3).all()
    assert (steps[1] % 4 % 2 == 0).all()
    other = asked.sample_seed(1, [1], 8)["latent"].squeeze(-1)
    assert (other.round() % 2 == 1).all()
    torch.testing.assert_close(other - other.round(), torch.full_like(other, 0.01))
    with pytest.raises(ValueError, match="every seed needs a transition"):
        asked.sample_seed(1, [1, 2], 8)


@pytest.mark.parametrize("n_steps", [0, 1, 12])
def test_a_restored_task_replay_continues_as_the_saved_one(n_steps):
    replay, restored = make_task_replay(), make_task_replay()
    fill(replay, n_steps=n_steps)
    fill(restored, first=50)
    if n_steps > 8:
        replay.sample()
    file = io.BytesIO()
    torch.save(replay.state_dict(), file)
    file.seek(0)
    restored.load_state_dict(torch.load(file, weights_only=True))
    assert restored.sizes.equal(replay.sizes)
    fill(replay, restored, first=n_steps)
    for _ in range(2):
        assert (restored.sample() == replay.sample()).all()
    assert (restored.sample_seed(0, [1], 9) == replay.sample_seed(0, [1], 9)).all()
    ours, theirs = TensorDict(replay.state_dict()), TensorDict(restored.state_dict())
    assert (ours == theirs).all()
