"""Behavior and group of an episode, and when GWR-B and the groups learn from it."""

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, SerialEnv, StepCounter, TransformedEnv, check_env_specs

from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.transforms import BehaviorLookup, GroupLookup
from tests.transforms.environment import MockEnv, make_modules, make_source, play


def compose(lookup, seeds, lengths):
    parts = Compose(StepCounter(50), make_source(seeds), lookup)
    return TransformedEnv(MockEnv(seeds, lengths), parts)


def make(seeds, lengths):
    gwr = make_modules(seeds)[2]
    return compose(BehaviorLookup(gwr, learn=True), seeds, lengths), gwr


def make_groups(seeds=None, lengths=3, learn=True):
    groups = [BehaviorGroups(32, smallest=4) for _ in seeds or [0]]
    return compose(GroupLookup(groups, learn=learn), seeds, lengths), groups


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
    before = gwr.get_extra_state()

    def assert_unchanged():
        torch.testing.assert_close(gwr.get_extra_state(), before, rtol=0, atol=0)

    check_env_specs(env, break_when_any_done="both")
    Collector(env, frames_per_batch=4, total_frames=4).shutdown(close_env=False)
    for _ in range(3):
        env.reset()
    assert_unchanged()
    env.transform[2].learn = False
    env.train()  # has no influence
    play(env, 12)
    assert_unchanged()
    env.transform[2].learn = True
    env.eval()  # nor has this
    play(env, 12)
    for now, then in zip(gwr.get_extra_state(), before, strict=True):
        assert not now["weights"].equal(then["weights"])


def test_learning_needs_a_step_counter_before_it():
    def make(*transforms, learn=True, base=None, seeds=None):
        lookup = BehaviorLookup(make_modules(seeds)[2], learn=learn)
        parts = Compose(*transforms, make_source(seeds), lookup)
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
    limited = TransformedEnv(MockEnv(), StepCounter(50))
    make(base=limited)[0].reset()
    make(base=SerialEnv(2, lambda: limited), seeds=[0, 1])[0].reset()


# ---- groups


def adapt(groups, count):
    """Adapt all rows to ``count`` demonstrations around three places."""
    generator = torch.Generator().manual_seed(0)
    for number in range(count):
        for of_row in groups:
            of_row.adapt(torch.rand(32, generator=generator) + 5 * (number % 3))


def look_up(groups, phi):
    """Groups and novelties ``[S, *B]`` of embeddings ``[S, *B, 32]``, row by row."""
    matches = [of_row.lookup(of) for of_row, of in zip(groups, phi, strict=True)]
    return torch.stack([m.group for m in matches]), torch.stack([m.novelty for m in matches])


@pytest.mark.parametrize(("seeds", "lengths"), [(None, 3), ([4, 2, 3], [2, 3, 5])])
def test_a_group_is_that_of_the_demonstration_and_groups_learn_when_episodes_end(seeds, lengths):
    """Rows whose episodes end at different times, against groups adapted by hand."""
    env, groups = make_groups(seeds, lengths, learn=False)
    check_env_specs(env)
    env.transform[-1].learn = True
    adapt(groups, 15)
    plain = deepcopy(groups)
    state = env.reset()
    assert not state["group"].any() and state["group_novelty"].isfinite().all()
    for _ in range(30):
        steps, following = play(env, 1, state.clone())
        ended = steps["next", "done"].view(env.batch_size)
        phi = state["demo_embedding"].view(len(groups), 32)
        for row in ended.flatten().nonzero().flatten().tolist():
            plain[row].adapt(phi[row])
        found = look_up(plain, following["demo_embedding"].view(len(groups), 32))
        for key, expected in zip(("group", "group_novelty"), found, strict=True):
            assert steps["next", key][..., -1].equal(state[key])  # constant in the episode
            expected = torch.where(ended, expected.view(env.batch_size), state[key])
            assert following[key].equal(expected)
        state = following
    for ours, theirs in zip(groups, plain, strict=True):
        assert str(ours.state_dict()) == str(theirs.state_dict())
        assert len(ours.points) > 14
        assert len(ours.numbers) > 1


def test_outside_an_environment_it_only_looks_up():
    _, groups = make_groups([4, 2])
    phi = torch.rand(2, 5, 32)
    adapt(groups, 15)
    lookup = GroupLookup(groups, learn=True)
    found = lookup(TensorDict({"demo_embedding": phi}, [2, 5]))
    group, novelty = look_up(groups, phi)
    assert found["group"].equal(group)
    assert found["group_novelty"].equal(novelty)
    assert found["group_novelty"].isfinite().all()
    assert all(len(of_row.points) == 15 for of_row in groups)
    with pytest.raises(ValueError, match="groups for 2 rows"):
        lookup(TensorDict({"demo_embedding": phi.transpose(0, 1)}, [5, 2]))


def test_bad_batch_sizes_are_refused():
    env, _ = make_groups([4, 2])
    other = [BehaviorGroups(32) for _ in range(3)]
    env.append_transform(GroupLookup(other, learn=True))
    with pytest.raises(ValueError, match="batch_size"):
        env.reset()
