"""Updates from demonstrations alone, before the first episode."""

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms import entry
from tests.algorithms.playing import assert_same
from tests.helpers import interrupt_call

pytestmark = pytest.mark.usefixtures("easy_world")
N = 7  # odd, since the actor learns in every other update


@pytest.fixture
def offline_config(make_config):
    """Settings of a run of two tasks, whose demonstrations form two groups, and a later one."""

    def make(name="bgpo", **changes):
        changes = {"algorithm": {"group_evidence": 0.5}, "offline_updates": N, **changes}
        return make_config(name=name, task_starts=(0, 0, 4), **changes)

    return make


@pytest.fixture
def first_save(begin):
    """Play until the first checkpoint; return the algorithm."""

    def play(directory, config):
        trainer = begin(directory, config)
        interrupt_call(trainer, trainer, "_act", 1)
        return trainer.algorithm

    return play


def test_updates_are_those_made_by_hand(first_save, offline_config, bank, encoders, tmp_path):
    config = offline_config()
    ours = first_save(tmp_path, config)
    by_hand = entry("bgpo").make(
        config.algorithm, seeds=config.seeds, bank=bank.seen(), encoders=encoders
    )
    seen = bank.seen()
    orders = [
        [int((seen.embedding.double() == point).all(1).nonzero()) for point in points]
        for points in (torch.from_numpy(groups.points) for groups in ours.groups)
    ]
    allowed = (seen.task < 2).nonzero().flatten().tolist()
    assert [sorted(order) for order in orders] == [allowed, allowed]
    assert orders[0] != orders[1]
    order = torch.tensor(orders).T
    for row in order:
        by_hand.gwr.adapt(seen.embedding[row])
        for groups, number in zip(by_hand.groups, row.tolist(), strict=True):
            groups.adapt(seen.embedding[number], by_hand.starts[number])
    for row in order:
        given = [by_hand.condition(i, seen.embedding[n], seen.task[n]) for i, n in enumerate(row)]
        episode = torch.stack(given).set("demo_index", row)
        paid = (episode["behavior"] - episode["demo_embedding"]).norm(dim=-1).neg().exp()
        by_hand.shown.add(episode, 1 + config.algorithm.beta * paid, episode["group"])
    numbers = [groups.numbers for groups in by_hand.groups]
    n_rows = config.algorithm.expert_batch_size
    for update in range(N):
        by_hand.experts.play([of_seed[update * len(of_seed) // N] for of_seed in numbers])
        group = by_hand.active.group.unsqueeze(-1).expand(-1, -1, n_rows)
        batch = TensorDict(by_hand.shown.draw(group), group.shape)
        imitated = by_hand.shown.draw_actions(group)
        for key, value in imitated.items():
            batch["imitation", key] = value
        by_hand.learner.learn(batch)
    before, after = ours.state_dict(), by_hand.state_dict()
    assert max(map(len, numbers)) > 1
    for part in ("learner", "experts", "gwr", "groups", "shown"):
        assert_same(before[part], after[part])


@pytest.mark.parametrize("name", ["bgpo", "demonstrations"])
def test_seeds_learn_alone_what_they_learn_beside_others(
    first_save, offline_config, tmp_path, name
):
    both = first_save(tmp_path / "both", offline_config(name))
    alone = first_save(tmp_path / "alone", offline_config(name, seeds=(8,)))
    fresh = entry(name).make(alone.config, seeds=(8,), bank=alone.bank, encoders=alone.encoders)
    for group in both.groups[1].numbers if both.groups else [0]:
        ours, theirs = both.actor_weights(1, group), alone.actor_weights(0, group)
        first = fresh.actor_weights(0)
        for key, value in ours.items():
            torch.testing.assert_close(value, theirs[key], rtol=0, atol=1e-6)
        assert any((value != first[key]).any() for key, value in ours.items())


@pytest.mark.parametrize("name", ["bgpo-experts", "maml-demonstrations", "dist-nll"])
def test_algorithms_without_demonstrations_to_replay_refuse(make_config, name):
    with pytest.raises(ValueError, match="offline_updates must be 0"):
        make_config(name=name, offline_updates=1)
