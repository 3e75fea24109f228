"""Behavior and group of an episode, and when GWR-B and the groups learn from it."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)

from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.transforms import BehaviorLookup, DemonstrationSource, GroupLookup, TaskSchedule
from tests.transforms.environment import MockEnv, generators, make_bank, make_modules, play


def compose(lookup, seeds, lengths):
    source = DemonstrationSource(
        make_bank(),
        TaskSchedule((0, 0, 0)),
        batch_size=lookup.network.batch_size,
        generator=generators(seeds or [0]),
    )
    return TransformedEnv(MockEnv(seeds, lengths), Compose(StepCounter(50), source, lookup))


def make(seeds=None, lengths=3, learn=True):
    gwr = make_modules(seeds)[2]
    return compose(BehaviorLookup(gwr, learn=learn), seeds, lengths), gwr


def make_groups(seeds=None, lengths=3, learn=True):
    batch_size = [] if seeds is None else [len(seeds)]
    groups = BehaviorGroups(32, batch_size=batch_size, smallest=4)
    return compose(GroupLookup(groups, learn=learn), seeds, lengths), groups


def snapshot(gwr):
    indices = range(gwr.batch_size.numel()) if gwr.batch_size else [()]
    return [[t.clone() for t in gwr.graph(index)] for index in indices]


def unchanged(gwr, before):
    return [
        all(torch.equal(a, b) for a, b in zip(now, then, strict=True))
        for now, then in zip(snapshot(gwr), before, strict=True)
    ]


@pytest.mark.parametrize("seeds", [None, [4, 2, 3]])
@pytest.mark.parametrize("learn", [True, False])
def test_the_behavior_is_set_at_reset_and_constant_in_the_episode(seeds, learn):
    env, gwr = make(seeds, learn=learn)
    check_env_specs(env)
    start = env.reset()
    expected = gwr.lookup(start["demo_embedding"])
    assert start["behavior"].equal(expected.embedding)
    assert start["behavior_node"].equal(expected.node)
    steps, _ = play(env, 3, start)  # one episode
    for key in ("behavior", "behavior_node"):
        for data in (steps, steps["next"]):
            dim = len(env.batch_size)
            assert data[key].equal(start[key].unsqueeze(dim).expand_as(data[key]))


def test_behaviors_are_those_of_algorithm_1():
    seeds, lengths, n_steps = [4, 2, 3], [1, 2, 5], 120
    env, gwr = make(seeds, lengths)
    steps, _ = play(env, n_steps)
    for row, (seed, length) in enumerate(zip(seeds, lengths, strict=True)):
        reference = make_modules([seed])[2]
        for start in range(0, n_steps, length):
            phi = steps["demo_embedding"][row, start].unsqueeze(0)
            match = reference.adapt(phi)  # b is from before adapting
            torch.testing.assert_close(steps["behavior"][row, start], match.embedding[0])
            assert steps["behavior_node"][row, start] == match.node[0]
        torch.testing.assert_close(gwr.graph(row).weights, reference.graph(0).weights)
    assert gwr.num_nodes[0] > 5  # it has grown; fixed points would agree in any order


def test_learns_only_from_whole_episodes_and_while_learn_is_set():
    env, gwr = make([0, 1], lengths=4)
    before = snapshot(gwr)
    check_env_specs(env, break_when_any_done="both")
    Collector(env, frames_per_batch=4, total_frames=4).shutdown(close_env=False)
    for _ in range(3):
        env.reset()
    assert all(unchanged(gwr, before))
    env.transform[2].learn = False
    env.train()  # has no influence
    play(env, 12)
    assert all(unchanged(gwr, before))
    env.transform[2].learn = True
    env.eval()  # nor has this
    play(env, 12)
    assert not any(unchanged(gwr, before))


def test_learning_needs_a_step_counter_before_it():
    def make(*transforms, learn=True, base=None):
        source = DemonstrationSource(make_bank(), TaskSchedule((0, 0, 0)))
        lookup = BehaviorLookup(make_modules()[2], learn=learn)
        parts = Compose(*transforms, source, lookup)
        return TransformedEnv(base or MockEnv(), parts, auto_unwrap=False), lookup

    with pytest.raises(ValueError, match=r"put StepCounter\(50\) before"):
        make()[0].reset()
    env, lookup = make(learn=False)
    env.reset()
    lookup.learn = True
    with pytest.raises(ValueError, match="StepCounter"):
        env.reset()
    env, _ = make()
    env.append_transform(StepCounter(5))
    with pytest.raises(ValueError, match="put StepCounter before"):
        env.reset()

    make(StepCounter())[0].reset()  # the environment has a limit of its own
    make(StepCounter(50, step_count_key="time"))[0].reset()
    make(base=TransformedEnv(MockEnv(), StepCounter(50)))[0].reset()


def test_a_time_limit_within_workers_suffices():
    base = SerialEnv(2, lambda: TransformedEnv(MockEnv(), StepCounter(50)))
    source = DemonstrationSource(make_bank(), TaskSchedule((0, 0, 0)), batch_size=[2])
    lookup = BehaviorLookup(make_modules([0, 1])[2], learn=True)
    assert "behavior" in TransformedEnv(base, Compose(source, lookup)).reset()


# ---- groups


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
    env, groups = make_groups(seeds, learn=False)
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
    env, groups = make_groups([4, 2, 3], lengths=[2, 3, 5])
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


def test_outside_an_environment_it_only_looks_up():
    _, groups = make_groups([4, 2])
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
    env, _ = make_groups([4, 2])
    other = BehaviorGroups(32, batch_size=[3])
    env.append_transform(GroupLookup(other, learn=True, out_keys=("other", "novelty")))
    with pytest.raises(ValueError, match="batch_size"):
        env.reset()
    lookup = GroupLookup(BehaviorGroups(32), learn=True)
    with pytest.raises(ValueError, match="'demo_embedding'"):
        lookup(TensorDict(batch_size=[]))
    with pytest.raises(ValueError, match="put DemonstrationSource before it"):
        TransformedEnv(MockEnv(), Compose(StepCounter(5), lookup)).reset()
