"""Replay by group against plain lists, and each seed of a stack against itself alone."""

import resource
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from bgpo_trl.data.replay import GroupReplay
from tests.helpers import through_a_file

KEYS = ["latent", ("next", "terminated")]


def generators(n, first=0):
    return [torch.Generator().manual_seed(first + seed) for seed in range(n)]


def transition(value, n_seeds):
    """Return a transition of each seed whose latent is the step, plus the seed in hundredths."""
    seed = torch.arange(n_seeds)
    number = (value + seed / 100).unsqueeze(-1)
    ends = seed.unsqueeze(-1) % 2 == 1
    return TensorDict({"latent": number, "other": seed, "next": {"terminated": ends}}, [n_seeds])


def make(capacity=100, n_seeds=2, first=0):
    return GroupReplay(capacity, generator=generators(n_seeds, first), keys=KEYS)


def fill(replay, groups):
    """Store a transition of each seed per step, given the groups of each step."""
    for step, of_step in enumerate(groups):
        replay.add(transition(step, len(of_step)), torch.tensor(of_step))


@settings(max_examples=60)
@given(
    capacity=st.integers(1, 9),
    stored=st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 3), st.booleans()), min_size=1, max_size=30
    ),
    asked=st.lists(st.integers(-1, 5), min_size=1, max_size=12),
    given_generators=st.booleans(),
    restored=st.integers(0, 40) | st.integers(0, 3),
)
def test_a_row_is_drawn_from_what_is_left_of_its_group(
    capacity, stored, asked, given_generators, restored
):
    """Also of a replay that is saved and restored before or between transitions."""
    replay, kept = make(capacity), [[], []]
    for step, (first, second, both) in enumerate(stored):
        both = both or step == 0  # so that each seed has something
        if step == restored:
            state, replay = through_a_file(replay.state_dict()), make(capacity, first=7)
            replay.load_state_dict(state)
        replay.add(transition(step, 2), torch.tensor([first, second]), torch.tensor([True, both]))
        kept[0] = [*kept[0], (first, step)][-capacity:]
        if both:
            kept[1] = [*kept[1], (second, step + 0.01)][-capacity:]
    group = torch.tensor([asked, asked[::-1]])
    held = [[[value for g, value in kept[s] if g == n] for n in group[s].tolist()] for s in (0, 1)]
    assert replay.sizes(group).tolist() == [[len(values) for values in rows] for rows in held]
    assert len(replay) == min(len(kept[0]), len(kept[1]))

    source = generators(2, 40) if given_generators else None
    drawn = replay.sample(group, generator=source)
    assert set(drawn.keys(True, True)) == {*KEYS, "priority_weight"}
    for seed, stream in enumerate(generators(2, 40 if given_generators else 0)):
        wanted = [number >= 0 for number in group[seed].tolist()]
        shares = iter(torch.rand(sum(wanted), generator=stream, dtype=torch.float64).tolist())
        for row, values in enumerate(held[seed]):
            share = next(shares) if wanted[row] else 0.0
            assert float(drawn["priority_weight"][seed, row]) == bool(values)
            if values:
                expected = values[int(share * len(values))]
                assert float(drawn["latent"][seed, row]) == pytest.approx(expected, abs=1e-5)
                assert bool(drawn["next", "terminated"][seed, row]) == (seed == 1)


@settings(max_examples=80)
@given(
    capacity=st.integers(1, 12),
    n_steps=st.integers(2, 4),
    played=st.lists(
        st.tuples(
            st.integers(0, 2), st.sampled_from(["on", "on", "success", "time-out"]), st.booleans()
        ),
        min_size=1,
        max_size=40,
    ),
    restored=st.booleans(),
)
def test_a_transition_of_several_steps_is_a_plain_walk(capacity, n_steps, played, restored):
    """To the end of its episode, or to the newest step; whatever has been overwritten."""
    keys = ["latent", *(("next", key) for key in ("latent", "reward", "terminated", "done"))]

    def make_replay(first):
        sources = generators(2, first)
        return GroupReplay(capacity, generator=sources, keys=keys, n_steps=n_steps, gamma=0.5)

    replay, held = make_replay(0), [[], []]
    for step, (group, ends, both) in enumerate(played):
        # Latents are numbers of steps, and rewards tell steps apart, also those before the end.
        flags = {"terminated": ends == "success", "done": ends != "on"}
        both = both or step == 0
        for kept in held[: 1 + both]:
            kept.append((group, step, step + 1, (step % 7) / 7, *flags.values()))
            del kept[:-capacity]
        following = {key: torch.full([2, 1], value) for key, value in flags.items()}
        following |= {"latent": torch.full([2, 1], step + 1.0)}
        following |= {"reward": torch.full([2, 1], (step % 7) / 7)}
        data = TensorDict({"latent": torch.full([2, 1], float(step)), "next": following}, [2])
        replay.add(data, torch.tensor([group, group]), torch.tensor([True, both]))
    if restored:
        state, replay = through_a_file(replay.state_dict()), make_replay(7)
        replay.load_state_dict(state)
    drawn = replay.sample(torch.arange(3).repeat_interleave(15).expand(2, 45))
    for seed, kept in enumerate(held):
        steps = [entry[1] for entry in kept]
        for row in drawn[seed][drawn["priority_weight"][seed] > 0]:
            at = steps.index(int(row["latent"]))
            walk = kept[at : at + n_steps]
            n_walked = next((n for n, entry in enumerate(walk, 1) if entry[-1]), len(walk))
            last = walk[n_walked - 1]
            reward = sum(0.5**n * entry[3] for n, entry in enumerate(walk[:n_walked]))
            assert row["steps_to_next_obs"].tolist() == [n_walked]
            assert row["next", "latent"].tolist() == [last[2]]
            assert row["next", "reward"].item() == pytest.approx(reward)
            assert row["next", "terminated"].item() == last[4]
            assert row["next", "done"].item() == last[5]


@settings(max_examples=60)
@given(
    capacity=st.integers(1, 12),
    played=st.lists(
        st.tuples(
            st.integers(0, 2),
            st.sampled_from(["goes on", "goes on, succeeding", "fails", "succeeds"]),
        ),
        min_size=1,
        max_size=40,
    ),
    restored=st.integers(0, 40),
    regrouped=st.booleans(),
)
def test_successes_are_the_steps_of_episodes_that_ended_with_one(
    capacity, played, restored, regrouped
):
    """Against a plain walk; also of a replay that is restored within an episode, or regrouped."""

    def empty():
        return GroupReplay(
            capacity,
            generator=generators(1),
            keys=["latent", ("next", "done")],
            source_key="source",
            success_key=("next", "success"),
        )

    replay, kept, episode = empty(), [], []
    for step, (group, outcome) in enumerate(played):
        if step == restored:
            state, replay = through_a_file(replay.state_dict()), empty()
            replay.load_state_dict(state)
        won = torch.tensor([[outcome in ("succeeds", "goes on, succeeding")]])
        done = torch.tensor([["goes on" not in outcome]])
        moment = {"latent": torch.tensor([[step]]), "source": torch.tensor([group])}
        after = {"done": done, "success": won}
        replay.add(TensorDict({**moment, "next": after}, [1]), torch.tensor([group]))
        episode.append((group, step))
        if done:
            kept += episode * bool(won)  # of the last step
            episode = []
    if regrouped:
        replay.regroup(0, torch.tensor([2, 0, 0]))
        kept = [([2, 0, 0][group], step) for group, step in kept]
    held = {step for _, step in kept if step >= len(played) - capacity}
    for group in range(3):
        drawn = replay.draw(torch.full((1, 60), group), successes=True)
        expected = {step for number, step in kept if number == group and step in held}
        weighed = drawn["priority_weight"][0] > 0
        assert weighed.all() == weighed.any() == bool(expected)
        assert {*drawn["latent"][0, weighed, 0].tolist()} <= expected
    replay.clear(0)
    assert len(replay) == 0


def test_the_latest_transitions_of_a_group_and_their_weights_by_hand():
    replay = make(capacity=5)
    fill(replay, [(0, 1), (0, 1), (1, 1), (0, 0), (0, 1), (1, 1), (0, 0)])  # the last five are left
    drawn = replay.latest(torch.tensor([[0, 1], [7, -1]]), 2)
    assert drawn["latent"][0].squeeze(-1).tolist() == [[4, 6], [2, 5]]
    assert drawn["priority_weight"].tolist() == [[[1, 1], [1, 1]], [[0, 0], [0, 0]]]
    assert not drawn["latent"][1].any()
    longer = replay.latest(torch.tensor([[1], [1]]), 4)
    assert longer["latent"][0].flatten().tolist() == [2, 5, 0, 0]
    assert longer["priority_weight"][0].tolist() == [[2, 2, 0, 0]]
    torch.testing.assert_close(longer["latent"][1].flatten(), torch.tensor([2.01, 4.01, 5.01, 0]))
    torch.testing.assert_close(longer["priority_weight"][1], torch.tensor([[4 / 3] * 3 + [0.0]]))
    with_nothing = make().latest(torch.tensor([[0], [-1]]), 3)
    assert not with_nothing["priority_weight"].any()


def test_some_seeds_draw_what_they_would_draw_with_all():
    some, every = make(n_seeds=3), make(n_seeds=3)
    for replay in (some, every):
        fill(replay, [(step % 2, 1, 0) for step in range(9)])
    asked = torch.tensor([[0, 1, 1, 0]])
    whole = every.sample(asked.expand(3, -1))
    drawn = some.sample(asked.expand(2, -1), seeds=[2, 0])
    has = whole["priority_weight"][[2, 0]] > 0
    assert drawn["priority_weight"].equal(whole["priority_weight"][[2, 0]])
    assert drawn["latent"][has].equal(whole["latent"][[2, 0]][has])
    # They alone have drawn, so that the other draws now what it did then.
    assert (some.sample(asked, seeds=[1])[0] == whole[1]).all()


def test_samples_share_nothing_with_the_buffer():
    replay = GroupReplay(4, generator=generators(1), keys=["action"])
    data = TensorDict({"action": torch.ones(1, 2, requires_grad=True)}, [1])
    replay.add(data, torch.tensor([0]))
    data["action"].data.zero_()
    rows = torch.zeros(1, 4, dtype=torch.int64)
    replay.sample(rows)["action"].zero_()
    assert {*replay.draw(rows, keys=[])} == {"priority_weight"}
    drawn = replay.sample(rows)["action"]
    assert (drawn == 1).all()
    assert not drawn.requires_grad


def test_rows_of_a_group_grow_beyond_a_thousand_and_are_forgotten():
    """Room for them grows by 1024 at a time."""
    replay = GroupReplay(1300, generator=generators(1), keys=["latent"])
    for step in range(1100 + 750):
        group = torch.tensor([int(step >= 1100)])
        replay.add(TensorDict({"latent": torch.full([1, 1], float(step))}, [1]), group)
    assert replay.sizes(torch.tensor([[0, 1]])).tolist() == [[550, 750]]
    for group, (first, end) in enumerate(((550, 1100), (1100, 1850))):
        drawn = replay.sample(torch.full((1, 500), group))["latent"]
        assert first <= drawn.min() and drawn.max() < end


def of_successes(keys=("latent",), success_key=("next", "success")):
    return GroupReplay(
        9, generator=generators(1), keys=[*keys, ("next", "done")], success_key=success_key
    )


def play(replay, n_steps, group=0):
    """Store an episode that succeeds."""
    for step in range(n_steps):
        ends = torch.tensor([[step == n_steps - 1]])
        moment = {"latent": torch.tensor([[step]]), "next": {"done": ends, "success": ends}}
        replay.add(TensorDict(moment, [1]), torch.tensor([group]))


def test_an_empty_replay_restored_over_another_knows_its_next_success():
    replay = of_successes()
    play(replay, 6)
    replay.load_state_dict(of_successes().state_dict())
    play(replay, 4)
    drawn = replay.draw(torch.zeros(1, 60, dtype=torch.int64), successes=True)
    assert {*drawn["latent"].flatten().tolist()} == {0, 1, 2, 3}
    assert drawn["priority_weight"].all()


@pytest.mark.parametrize("other", [{"keys": ("latent", "joints")}, {"success_key": None}])
def test_a_replay_of_other_entries_is_refused_and_changes_nothing(other):
    saved, replay = of_successes(), of_successes(**other)
    play(saved, 3)
    with pytest.raises(ValueError, match="build it with the saved keys"):
        replay.load_state_dict(saved.state_dict())
    assert len(replay) == 0


def test_a_seed_is_restored_though_another_has_stored_nothing_yet():
    replay, restored = make(10), make(10)
    only_first = torch.tensor([True, False])
    replay.add(transition(4, 2), torch.tensor([3, 3]), only_first)
    restored.load_state_dict(through_a_file(replay.state_dict()))
    asked = torch.tensor([[3], [3]])
    assert restored.sizes(asked).tolist() == [[1], [0]]
    with pytest.raises(ValueError, match="every seed needs a transition"):
        restored.sample(asked)
    restored.add(transition(5, 2), torch.tensor([0, 0]), ~only_first)
    drawn = restored.sample(asked)
    assert drawn["priority_weight"].tolist() == [[1.0], [0.0]]
    assert drawn["latent"][0].item() == 4


@pytest.mark.parametrize("n_steps", [1, 3])
def test_rows_of_the_only_seed_are_zeros_where_memory_is_not(monkeypatch, n_steps):
    keys = ["latent", ("next", "reward"), ("next", "done")]
    replay, restored = (
        GroupReplay(10, generator=generators(1), keys=keys, n_steps=n_steps) for _ in range(2)
    )
    following = {"reward": torch.ones(1, 1), "done": torch.ones(1, 1, dtype=torch.bool)}
    data = TensorDict({"latent": torch.ones(1, 1), "next": following}, [1])
    replay.add(data, torch.tensor([0]))
    replay.clear(0)
    state = through_a_file(replay.state_dict())
    monkeypatch.setattr(
        torch, "empty", lambda *shape, dtype: torch.full(shape, torch.nan).to(dtype)
    )
    restored.load_state_dict(state)
    drawn = restored.sample(torch.tensor([[-1]]))
    assert not any(drawn[key].any() for key in (*keys, "priority_weight"))


BAD = {
    "batch size": (transition(0, 3), None),
    "found no 'latent'": (transition(0, 2).exclude("latent"), None),
    "latent.*as stored before": (transition(0, 2).set("latent", torch.zeros(2, 5)), None),
    "terminated.*bool": (transition(0, 2).set(("next", "terminated"), torch.zeros(2, 1)), None),
    "mask": (transition(0, 2), torch.ones(2)),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_transitions_change_nothing(message):
    replay = make(2)
    fill(replay, [(0, 1)] * 2)
    before = replay.state_dict()
    data, mask = BAD[message]
    with pytest.raises(ValueError, match=message):
        replay.add(data, torch.zeros(len(data), dtype=torch.int64), mask)
    after = replay.state_dict()
    assert (TensorDict(after) == TensorDict(before)).all()
    assert replay.sizes(torch.tensor([[0, 1], [0, 1]])).tolist() == [[2, 0], [0, 2]]


def test_a_negative_group_is_refused_where_it_would_be_stored():
    replay = make(10)
    with pytest.raises(ValueError, match=r"a group must be at least 0, got \[-1, 1\]"):
        replay.add(transition(4, 2), torch.tensor([-1, 1]))
    assert replay.sizes(torch.tensor([[1], [1]])).tolist() == [[0], [0]]
    replay.add(transition(4, 2), torch.tensor([-1, 1]), torch.tensor([False, True]))
    drawn = replay.sample(torch.tensor([[1]]), seeds=[1])  # of seed 0 there is nothing to draw
    assert drawn["latent"].item() == transition(4, 2)["latent"][1].item()


def test_transitions_follow_their_source_to_another_group():
    replay = GroupReplay(5, generator=generators(2), keys=["latent"], source_key="source")
    for step in range(7):
        source = torch.tensor([step % 3, 0])
        replay.add(transition(step, 2).set("source", source), torch.tensor([0, 0]))
    replay.regroup(0, torch.tensor([4, 2, 4]))
    assert replay.sizes(torch.tensor([[0, 2, 4], [0, 2, 4]])).tolist() == [[0, 1, 4], [5, 0, 0]]
    drawn = replay.sample(torch.tensor([[2] * 20 + [4] * 80, [0] * 100]))
    assert set(drawn.keys()) == {"latent", "priority_weight"}
    steps = drawn["latent"][0, :, 0].round()
    assert steps[:20].unique().tolist() == [4]
    assert steps[20:].unique().tolist() == [2, 3, 5, 6]
    with pytest.raises(ValueError, match="source_key"):
        make().regroup(0, torch.tensor([0]))


def test_capacity_costs_no_memory_until_it_is_filled():
    unit = 1 if sys.platform == "darwin" else 1024
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    replay = GroupReplay(1_000_000, generator=generators(10), keys=["latent"])
    group = torch.zeros(10, dtype=torch.int64)
    replay.add(TensorDict({"latent": torch.zeros(10, 128)}, [10]), group)
    replay.sample(group.unsqueeze(-1))
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert growth * unit < 100e6  # the whole is 5 GB


def test_bad_sizes_are_refused():
    with pytest.raises(ValueError, match="capacity"):
        make(0)
    with pytest.raises(ValueError, match="number of generators"):
        make(n_seeds=0)
    other = make(3)
    fill(other, [(0, 0)])
    with pytest.raises(ValueError, match="capacity 4 and 2 seeds"):
        other.load_state_dict(make(4).state_dict())
    assert len(other) == 1
