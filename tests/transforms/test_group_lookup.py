"""GroupLookup: the group of an episode, and when groups learn from it."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, StepCounter, TransformedEnv, check_env_specs

from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.transforms import BehaviorLookup, DemonstrationSource, GroupLookup, TaskSchedule
from tests.transforms.environment import MockEnv, generators, make_bank, make_modules, play


def make(seeds=None, lengths=3, learn=True):
    batch_size = [] if seeds is None else [len(seeds)]
    groups = BehaviorGroups(32, batch_size=batch_size, smallest=4)
    source = DemonstrationSource(
        make_bank(),
        TaskSchedule((0, 0, 0)),
        batch_size=batch_size,
        generator=generators(seeds or [0]),
    )
    lookup = GroupLookup(groups, learn=learn)
    env = TransformedEnv(MockEnv(seeds, lengths), Compose(StepCounter(50), source, lookup))
    return env, groups


def adapt(groups, count):
    """Adapt all rows to ``count`` demonstrations around three places."""
    generator = torch.Generator().manual_seed(0)
    for number in range(count):
        noise = torch.rand(*groups.batch_size, 32, generator=generator)
        groups.adapt(noise + 5 * (number % 3))


def copy_of(groups):
    copy = BehaviorGroups(32, batch_size=groups.batch_size, smallest=4)
    copy.load_state_dict(groups.state_dict())
    return copy


@pytest.mark.parametrize("seeds", [None, [4, 2, 3]])
@pytest.mark.parametrize("learn", [True, False])
def test_the_group_is_set_at_reset_and_constant_in_the_episode(seeds, learn):
    env, groups = make(seeds, learn=False)
    check_env_specs(env)
    env.transform[-1].learn = learn
    adapt(groups, 15)
    assert (groups.revision == 0).all()
    start = env.reset()
    assert start["group"].equal(torch.zeros(env.batch_size, dtype=torch.int64))
    assert start["group_novelty"].isfinite().all()
    for _ in range(6):
        expected = groups.lookup(start["demo_embedding"])
        assert start["group"].equal(expected.group)
        assert start["group_novelty"].equal(expected.novelty)
        steps, following = play(env, 3, start.clone())  # one episode
        for key in ("group", "group_novelty"):
            for data in (steps, steps["next"]):
                assert (data[key] == start[key].unsqueeze(-1)).all()
        start = following
    assert bool((groups.num_groups > 1).all()) == learn


def test_groups_learn_from_episodes_that_end_only():
    """Seeds whose episodes end at different times, against groups adapted by hand."""
    env, groups = make([4, 2, 3], lengths=[2, 3, 5])
    adapt(groups, 15)
    plain = copy_of(groups)
    state = env.reset()
    for _ in range(30):
        steps, following = play(env, 1, state.clone())
        ended = steps["next", "done"].flatten()
        if ended.any():
            plain.adapt(state["demo_embedding"], ended)
        assert plain.num_groups.equal(groups.num_groups)
        again = plain.lookup(following["demo_embedding"])
        assert following["group"][ended].equal(again.group[ended])
        assert following["group"][~ended].equal(state["group"][~ended])
        assert following["group_novelty"][~ended].equal(state["group_novelty"][~ended])
        state = following
    for ours, theirs in zip(groups.get_extra_state(), plain.get_extra_state(), strict=True):
        assert ours["points"].equal(theirs["points"]) and ours["group"].equal(theirs["group"])
        assert len(ours["points"]) > 14
    assert groups.num_groups.min() > 1


def test_a_row_of_a_batch_is_that_seed_alone():
    seeds, lengths = [4, 2, 3], [2, 3, 5]
    env, groups = make(seeds, lengths)
    together, _ = play(env, 30)
    for i, (seed, length) in enumerate(zip(seeds, lengths, strict=True)):
        env_alone, groups_alone = make([seed], [length])
        alone, _ = play(env_alone, 30)
        for key in ("group", "demo_index"):
            assert together[key][i].equal(alone[key][0])
        assert groups.num_groups[i] == groups_alone.num_groups[0]


def test_the_order_of_the_two_lookups_does_not_matter():
    seen = []
    for group_first in (True, False):
        env, _ = make([4, 2])
        lookup = BehaviorLookup(make_modules([4, 2])[2], learn=True)
        if group_first:
            env.append_transform(lookup)
        else:
            env.insert_transform(2, lookup)
        seen.append(play(env, 20)[0])
    for key in ("group", "group_novelty", "behavior", "behavior_node"):
        assert seen[0][key].equal(seen[1][key])


def test_outside_an_environment_it_only_looks_up():
    _, groups = make([4, 2])
    phi = torch.rand(2, 5, 32)
    adapt(groups, 15)
    lookup = GroupLookup(groups, learn=True)
    found = lookup(TensorDict({"demo_embedding": phi}, [2, 5]))
    expected = groups.lookup(phi)
    assert found["group"].equal(expected.group)
    assert found["group_novelty"].equal(expected.novelty)
    assert found["group_novelty"].isfinite().all()
    assert all(len(state["points"]) == 15 for state in groups.get_extra_state())


def test_bad_batch_sizes_and_missing_entries_are_refused():
    env, _ = make([4, 2])
    other = BehaviorGroups(32, batch_size=[3])
    env.append_transform(GroupLookup(other, learn=True, out_keys=("other", "novelty")))
    with pytest.raises(ValueError, match="batch_size"):
        env.reset()
    lookup = GroupLookup(BehaviorGroups(32), learn=True)
    with pytest.raises(ValueError, match="'demo_embedding'"):
        lookup(TensorDict(batch_size=[]))
    with pytest.raises(ValueError, match="put DemonstrationSource before it"):
        TransformedEnv(MockEnv(), Compose(StepCounter(5), lookup)).reset()


def test_its_novelty_has_the_dtype_of_the_embedding():
    lookup = GroupLookup(BehaviorGroups(4), learn=False)
    found = lookup(TensorDict({"demo_embedding": torch.rand(5, 4).double()}, [5]))
    assert found["group_novelty"].dtype == torch.float64
