"""BehaviorLookup: the behavior of an episode, and when GWR-B learns from it."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)

from bgpo_trl.transforms import BehaviorLookup, DemonstrationSource, TaskSchedule
from tests.transforms.environment import MockEnv, generators, make_bank, make_modules, play


def make(seeds=None, lengths=3, learn=True, behavior=None):
    gwr = make_modules(seeds)[2]
    source = DemonstrationSource(
        make_bank(),
        TaskSchedule((0, 0, 0)),
        batch_size=gwr.batch_size,
        generator=generators(seeds or [0]),
    )
    behavior = behavior or BehaviorLookup(gwr, learn=learn)
    env = MockEnv(seeds, lengths)
    return TransformedEnv(env, Compose(StepCounter(50), source, behavior)), gwr


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


def test_a_network_serves_several_episodes_of_its_seed():
    gwr = make_modules([0, 1])[2]
    source = DemonstrationSource(make_bank(), TaskSchedule((0, 0, 0)), batch_size=[2, 4])
    lookup = BehaviorLookup(gwr, learn=False)
    env = TransformedEnv(MockEnv([[0] * 4, [1] * 4]), Compose(StepCounter(50), source, lookup))
    data = env.reset()
    assert data["behavior"].equal(gwr.lookup(data["demo_embedding"]).embedding)


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


def test_a_replay_buffer_with_a_lookup_is_saved_and_loaded():
    def buffer():
        lookup = BehaviorLookup(make_modules()[2], learn=False)
        return TensorDictReplayBuffer(storage=LazyTensorStorage(4), transform=lookup, batch_size=4)

    first, second = buffer(), buffer()
    first.extend(TensorDict({"demo_embedding": torch.rand(4, 32)}, [4]))
    second.load_state_dict(first.state_dict())
    drawn = second.sample()
    assert drawn["behavior"].equal(
        first._transform[0].network.lookup(drawn["demo_embedding"]).embedding
    )
