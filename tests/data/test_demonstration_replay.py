"""Transitions of shown demonstrations, against the bank's own steps."""

import itertools
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.data.demonstration_replay import DemonstrationReplay

CONSTANT = ["behavior", "label"]


def make(bank, n_seeds=2, **options):
    streams = [torch.Generator().manual_seed(seed) for seed in range(n_seeds)]
    return DemonstrationReplay(bank, generator=streams, constant_keys=CONSTANT, **options)


def episode(*index):
    """An episode of each seed, which was told the number of its demonstration and of its seed."""
    number, seed = torch.tensor(index), torch.arange(len(index))
    behavior = torch.stack([number, seed], -1).float()
    return TensorDict({"demo_index": number, "behavior": behavior, "label": seed}, [len(index)])


def show(replay, *shown):
    """Adds for each of the tuples (index, reward, group) one to each of the seeds."""
    for one in shown:
        index, reward, group = zip(*one, strict=True)
        replay.add(episode(*index), torch.tensor(reward), torch.tensor(group))


@pytest.fixture
def make_shown(bank):
    def make_shown(bank=bank, **options):
        replay = make(bank.seen(), **options)
        show(
            replay,
            [(3, 1.0, 0), (5, 1.02, 0)],
            [(7, 1.05, 1), (9, 1.0, 0)],
            [(3, 1.07, 0), (11, 1.1, 2)],
        )
        return replay

    return make_shown


GROUP = torch.tensor([[0, 0, 1, -1, 2], [0, 2, 2, 0, 1]])


def test_states_are_bounded_as_those_of_episodes(make_shown):
    bounded, plain = make_shown(limit=0.5, noise=0.0), make_shown(noise=0.0)
    for draw in ("draw", "draw_actions"):
        ours, theirs = (getattr(replay, draw)(GROUP) for replay in (bounded, plain))
        for key in {"latent", ("next", "latent")} & ours.keys():
            assert theirs[key].abs().max() > 0.5
            assert ours[key].equal(theirs[key].clamp(-0.5, 0.5))


def transitions(steps, index, n_steps):
    """All of a demonstration's, from its frames: latent, action, steps, next latent, the end."""
    frames = torch.arange(int(steps.length[index])) + steps.first[index]
    latents, actions = steps.latents(frames), steps.actions(frames)
    n = len(frames) - 1
    of_each = [(t, min(n_steps, n - t)) for t in range(n)]
    return [(latents[t], actions[t], k, latents[t + k], t + k == n) for t, k in of_each]


@pytest.mark.parametrize("n_steps", [1, 3])
def test_transitions_are_the_steps_of_what_was_shown_in_the_rows_group(make_shown, bank, n_steps):
    shown, steps = make_shown(n_steps=n_steps, gamma=0.5), bank.seen().steps
    told = {  # seed and group: demonstrations with their rewards
        (0, 0): {3: {1.0, 1.07}},
        (0, 1): {7: {1.05}},
        (1, 0): {5: {1.02}, 9: {1.0}},
        (1, 2): {11: {1.1}},
    }
    found = {key: set() for key in told}
    for _ in range(60):
        drawn = TensorDict(shown.draw(GROUP), GROUP.shape)
        assert drawn["priority_weight"].tolist() == [[1, 1, 1, 0, 0], [1, 1, 1, 1, 0]]
        for seed, row in itertools.product(range(2), range(5)):
            key = seed, int(GROUP[seed, row])
            if key not in told:
                continue
            one = drawn[seed, row]
            index = int(one["behavior"][0])
            assert one["behavior"][1] == one["label"] == seed
            of_index = transitions(steps, index, n_steps)
            (place,) = (t for t, step in enumerate(of_index) if step[0].equal(one["latent"]))
            _, action, n_taken, following, ends = of_index[place]
            assert one["action"].equal(action)
            assert one.get("steps_to_next_obs", torch.tensor([1])).tolist() == [n_taken]
            assert one["next", "latent"].equal(following)
            assert one["next", "terminated"].tolist() == [ends]
            rewards = {0.5 ** (n_taken - 1) * r for r in told[key][index]} if ends else {0.0}
            assert min(abs(float(one["next", "reward"]) - r) for r in rewards) < 1e-6
            found[key].add((index, place))
    for key, of_group in told.items():
        every = {(i, t) for i in of_group for t in range(int(steps.length[i]) - 1)}
        assert found[key] == every


def test_what_is_to_be_imitated_are_the_same_draws_with_noise_on_the_states_alone(make_shown, bank):
    """A seed's own noise, however many slots are free; by default, as much as the bank says."""
    plain, quiet, wide = (make_shown(n_steps=3, noise=x) for x in (0.3, 0.0, 0.4))
    noisy = make_shown(replace(bank, noise=0.4), n_steps=3)
    group = torch.zeros(2, 4_000, dtype=torch.int64)
    sampled, still, drawn = (
        plain.draw(group),
        quiet.draw_actions(group),
        noisy.draw_actions(group),
    )
    assert {*drawn} == {"latent", "action", "priority_weight", *CONSTANT}
    for key, value in still.items():
        assert sampled[key].equal(value)
        assert drawn[key].equal(value) == (key != "latent")
    noise = drawn["latent"] - still["latent"]
    assert float(noise.mean()) == pytest.approx(0.0, abs=0.01)
    assert float(noise.std()) == pytest.approx(0.4, abs=0.01)
    free = torch.full([2, 4_000], -1)
    spread = wide.draw_actions(torch.stack([group, free], -1).view(2, -1))
    assert spread["latent"][:, ::2].equal(drawn["latent"])
    assert not spread["priority_weight"][:, 1::2].any()


def test_a_pace_changes_what_is_imitated_and_not_what_was_done(make_shown):
    plain, fast = make_shown(noise=0.0), make_shown(noise=0.0, pace=1.5)
    group = torch.zeros(2, 500, dtype=torch.int64)
    action = plain.draw_actions(group)["action"]
    assert fast.draw_actions(group)["action"].equal((1.5 * action).clamp(-1, 1))
    assert (1.5 * action).abs().max() > 1  # so that some stay at the ends
    assert fast.draw(group)["action"].equal(plain.draw(group)["action"])


def test_constants_are_of_any_demonstration_of_the_group_if_not_its_own(bank):
    replay = make(bank.seen(), own_constants=False)
    show(replay, [(3, 1.0, 0), (5, 1.0, 0)], [(4, 1.0, 0), (6, 1.0, 0)], [(7, 1.0, 1), (8, 1.0, 1)])
    steps = bank.seen().steps
    drawn = replay.draw(torch.tensor([[0, 1]]).expand(2, 2).repeat_interleave(300, 1))
    frames = torch.stack([steps.latents(steps.first), steps.latents(steps.first + 1)], 1)
    for seed, members in enumerate(((3, 4), (5, 6))):
        told = drawn["behavior"][seed, :300, 0].long()
        pairs = set()
        for number in members:
            of = (drawn["latent"][seed, :300, None] == frames[number]).all(-1).any(-1)
            pairs |= {(number, one) for one in told[of].tolist()}
        assert pairs == {(one, other) for one in members for other in members}
        assert drawn["behavior"][seed, 300:, 0].unique().tolist() == [7 + seed]


def test_demonstrations_and_their_steps_are_drawn_equally_often(bank):
    """A long demonstration is drawn no more often than a short one."""
    replay = make(bank.seen(), n_seeds=1)
    lengths = bank.seen().steps.length
    short, long = int(lengths.argmin()), int(lengths.argmax())
    assert (int(lengths[short]), int(lengths[long])) == (3, 6)
    show(replay, [(short, 1.0, 0)], [(long, 1.0, 0)])
    group = torch.zeros(1, 20_000, dtype=torch.int64)
    drawn = TensorDict(replay.draw(group), group.shape)[0]
    is_long = drawn["behavior"][:, 0] == long
    assert abs(int(is_long.sum()) - 10_000) < 5 * 5_000**0.5
    for rows, n_steps in ((is_long, 5), (~is_long, 2)):
        ends = drawn["next", "terminated"][rows].float().mean()
        assert float(ends) == pytest.approx(1 / n_steps, abs=0.03)


def test_a_bank_without_steps_is_refused(bank):
    with pytest.raises(ValueError, match="has no steps of demonstrations to learn from"):
        make(replace(bank.seen(), steps=None))
    # Those of held-out demonstrations are not kept.
    with pytest.raises(ValueError, match="has no steps of demonstration 24 to learn from"):
        make(bank)
