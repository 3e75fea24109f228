"""Replay by task against plain lists, and the share of it that is taken from demonstrations."""

import io

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from bgpo_trl.data.demonstration_replay import DemonstrationReplay
from bgpo_trl.data.task_replay import TaskReplay

N_SEEDS, N_TASKS = 2, 3
KEYS = ["latent", "action", *(("next", key) for key in ("latent", "reward", "terminated"))]


def generators(n=N_SEEDS, first=0):
    return [torch.Generator().manual_seed(first + seed) for seed in range(n)]


def of_tasks(value, *tasks, done=False):
    """A transition of each seed with its task; its latent says when and whose it was."""
    n_seeds = len(tasks)
    number = (value + torch.arange(n_seeds) / 100).unsqueeze(-1).expand(-1, 64)
    ended = torch.as_tensor(done).expand(n_seeds).unsqueeze(-1).clone()
    following = {"latent": number + 0.5, "reward": ended.float()}
    following |= {"terminated": ended, "done": ended.clone()}
    data = {"latent": number, "action": torch.zeros(n_seeds, 4), "next": following}
    data |= {"task": torch.tensor(tasks), "demo_index": torch.tensor(tasks)}
    return TensorDict(data, [n_seeds])


def make(capacity=15, batch_size=3, generator=None, **options):
    generator = generators() if generator is None else generator
    options = {"n_tasks": N_TASKS, "keys": KEYS, **options}
    return TaskReplay(capacity, batch_size=batch_size, generator=generator, **options)


def step_of(drawn):
    return drawn["latent"][..., 0].round().long()


@settings(max_examples=40)
@given(
    capacity=st.integers(3, 12),
    played=st.lists(
        st.tuples(st.integers(0, N_TASKS - 1), st.integers(0, N_TASKS - 1)), max_size=25
    ),
    batch_size=st.integers(1, 3),
    n_drawn=st.sampled_from([None, 1, 9]),
    given_generators=st.booleans(),
)
def test_each_task_of_each_seed_is_drawn_from_by_itself(
    capacity, played, batch_size, n_drawn, given_generators
):
    replay = make(capacity, batch_size)
    for value, tasks in enumerate(played):
        replay.add(of_tasks(value, *tasks))
    kept = list(enumerate(played))[-capacity:]
    rings = [
        [[value + seed / 100 for value, tasks in kept if tasks[seed] == task] for task in range(3)]
        for seed in range(N_SEEDS)
    ]
    sizes = torch.tensor([[len(ring) for ring in of_seed] for of_seed in rings])
    ready = sizes >= batch_size
    assert replay.sizes.equal(sizes)
    assert replay.ready.equal(ready)
    assert len(replay) == len(kept)

    streams = None if not given_generators else generators(first=90)

    def sample():
        if n_drawn is None:
            return replay.sample()
        return replay.sample_played(n_drawn, generator=streams)

    if not ready.any():
        with pytest.raises(ValueError, match="no task fills a batch yet"):
            sample()
        return
    batch, n_rows = sample(), n_drawn or batch_size
    assert batch.batch_size == (N_SEEDS, N_TASKS, n_rows)
    assert set(batch.keys(True, True)) == {*KEYS, "priority_weight"}
    expected = ready.float().unsqueeze(-1).expand(-1, -1, n_rows)
    assert batch["priority_weight"].equal(expected)
    first = 90 if given_generators and n_drawn else 0
    for seed, stream in enumerate(generators(first=first)):
        n_ready = int(ready[seed].sum())
        shares = torch.rand(n_ready * n_rows, generator=stream, dtype=torch.float64)
        for task, rows in zip(
            ready[seed].nonzero().flatten(), shares.view(n_ready, n_rows), strict=True
        ):
            ring = torch.tensor(rings[seed][task])
            drawn = batch["latent"][seed, task, :, 0]
            torch.testing.assert_close(drawn, ring[(rows * len(ring)).long()])


def fill(*replays, n_steps=12, first=0):
    """Adds transitions of changing tasks; the third task of the second seed has none."""
    for step in range(first, first + n_steps):
        for replay in replays:
            replay.add(of_tasks(step, (0, 1, 0, 2)[step % 4], step % 2))


def test_tasks_that_do_not_fill_a_batch_draw_nothing():
    streams = generators()
    replay = make(batch_size=4, generator=streams)
    fill(replay, n_steps=6)
    assert replay.sizes.tolist() == [[3, 2, 1], [3, 3, 0]]
    replay.add(of_tasks(9, 0, 2))
    replay.sample()
    expected = generators()
    torch.rand(4, generator=expected[0], dtype=torch.float64)  # one task of the first seed
    for stream, other in zip(streams, expected, strict=True):
        assert stream.get_state().equal(other.get_state())


def test_enough_transitions_fill_a_batch_of_a_task_whichever_they_are_of():
    replay = make(capacity=27, batch_size=3)
    assert replay.enough == 7
    for step in range(6):  # as evenly as can be
        replay.add(of_tasks(step, step % 3, 0))
    assert not replay.ready[0].any()
    replay.add(of_tasks(6, 1, 0))
    assert len(replay) == replay.enough
    assert replay.ready.any(-1).all()


def test_a_seed_in_a_batch_of_task_replays_is_that_seed_alone():
    together = make()
    alone = [make(generator=[stream]) for stream in generators()]
    for step in range(20):
        data = of_tasks(step, (0, 1, 0, 2)[step % 4], step % 2)
        together.add(data)
        for seed, replay in enumerate(alone):
            replay.add(data[seed : seed + 1])
            assert replay.sizes[0].equal(together.sizes[seed])
        if all(replay.ready.any() for replay in alone):
            drawn = together.sample()
            for seed, replay in enumerate(alone):
                ready, other = together.ready[seed], replay.sample()[0]
                assert (other[ready] == drawn[seed][ready]).all()
    assert together.ready.tolist() == [[True, True, True], [True, True, False]]


def test_tasks_of_a_seed_are_drawn_in_the_order_asked_for():
    replay = make(capacity=50)
    fill(replay)
    drawn = replay.sample_seed(0, [2, 0], 8)
    assert drawn.batch_size == (2, 8)
    assert (drawn["priority_weight"] == 1).all()
    steps = step_of(drawn)
    assert (steps[0] % 4 == 3).all()
    assert (steps[1] % 4 % 2 == 0).all()
    other = replay.sample_seed(1, [1], 8)["latent"][..., 0]
    assert (other.round() % 2 == 1).all()
    torch.testing.assert_close(other - other.round(), torch.full_like(other, 0.01))


def test_all_tasks_of_a_seed_share_its_capacity():
    replay = make(capacity=6)
    for step in range(9):
        replay.add(of_tasks(step, min(step // 4, 2), 0))
    assert replay.sizes.tolist() == [[1, 4, 1], [6, 0, 0]]


@pytest.fixture
def make_with_demonstrations(bank):
    def make_with_demonstrations(share=0.5, first=0, batch_size=4):
        shown = DemonstrationReplay(bank.seen(), generator=generators(first=70 + first))
        return make(
            100,
            batch_size,
            generators(first=first),
            demonstrations=shown,
            demonstration_share=share,
        )

    return make_with_demonstrations


def play(replay, n_steps, first=0):
    """Tasks 0 and 1 by turns; each second step ends an episode, and with it a demonstration."""
    for step in range(first, first + n_steps):
        replay.add(of_tasks(1000 + step, step // 2 % 2, 1, done=step % 2 == 1))


@pytest.mark.parametrize(("share", "n_shown"), [(0.0, 0), (0.25, 1), (0.5, 2), (0.7, 3)])
def test_a_share_of_each_tasks_batch_comes_last_from_its_demonstrations(
    make_with_demonstrations, bank, share, n_shown
):
    replay = make_with_demonstrations(share)
    play(replay, 12)
    steps, seen = bank.seen().steps, set()
    for _ in range(20):
        batch = replay.sample()
        assert batch.batch_size == (2, 3, 4)
        assert batch["priority_weight"][:, :, 0].tolist() == [[1, 1, 0], [0, 1, 0]]
        assert batch["priority_weight"].std(-1).eq(0).all()
        played, shown = batch[..., : 4 - n_shown], batch[..., 4 - n_shown :]
        for seed, task in ((0, 0), (0, 1), (1, 1)):
            assert (step_of(played[seed, task]) >= 1000).all()
            # The demonstration shown in these episodes is that of the task's number.
            of_task = range(int(steps.first[task]), int(steps.first[task] + steps.length[task] - 1))
            latents = steps.latents(torch.tensor(of_task))
            for row in shown[seed, task]:
                (place,) = (latents == row["latent"]).all(-1).nonzero().flatten().tolist()
                seen.add((task, place))
                assert bool(row["next", "terminated"]) == (place == len(latents) - 1)
                assert float(row["next", "reward"]) == float(row["next", "terminated"])
    expected = {(task, n) for task in (0, 1) for n in range(int(steps.length[task]) - 1)}
    assert seen == (expected if n_shown else set())


def test_before_a_demonstration_was_shown_all_of_a_batch_was_played(make_with_demonstrations):
    replay = make_with_demonstrations()
    for step in range(8):
        replay.add(of_tasks(1000 + step, 0, 0, done=[False, step == 7]))
    assert (step_of(replay.sample()[:, 0]) >= 1000).all()


def test_what_is_adapted_to_was_played(make_with_demonstrations):
    replay = make_with_demonstrations()
    play(replay, 12)
    assert (step_of(replay.sample_played(50)[1, 1]) >= 1000).all()
    assert (step_of(replay.sample_seed(0, [1, 0], 50)) >= 1000).all()


@pytest.mark.parametrize("n_steps", [0, 1, 14])
@pytest.mark.parametrize("demonstrations", [False, True])
def test_a_restored_task_replay_continues_as_the_saved_one(
    make_with_demonstrations, n_steps, demonstrations
):
    def new(first=0):
        return (
            make_with_demonstrations(first=first)
            if demonstrations
            else make(generator=generators(first=first))
        )

    replay, restored = new(), new(first=5)
    play(replay, n_steps)
    play(restored, 3, first=50)
    if n_steps > 12:
        replay.sample()
    file = io.BytesIO()
    torch.save(replay.state_dict(), file)
    file.seek(0)
    restored.load_state_dict(torch.load(file, weights_only=True))
    assert restored.sizes.equal(replay.sizes)
    for one in (replay, restored):
        play(one, 14, first=n_steps)
    for _ in range(2):
        assert (restored.sample() == replay.sample()).all()
    assert (restored.sample_seed(0, [1], 9) == replay.sample_seed(0, [1], 9)).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_tasks": 0}, "at least one seed and one task"),
        ({"generator": []}, "at least one seed and one task"),
        ({"capacity": 2}, "capacity must be at least batch_size 3, got 2"),
    ],
)
def test_arguments_without_a_meaning_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)


def test_a_task_whose_transitions_are_all_overwritten_has_no_weight():
    replay = make(capacity=4, batch_size=3)
    for step in range(4):
        replay.add(of_tasks(step, 0, 0))
    for step in range(4):
        replay.add(of_tasks(step, 1, 1))
    assert replay.sample_seed(0, [0, 1], 8)["priority_weight"].unique(dim=1).tolist() == [[0], [1]]
