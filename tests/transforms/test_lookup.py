"""Behavior and group of an episode, and when GWR-B and the groups learn from it."""

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    RandomTruncationTransform,
    RenameTransform,
    SerialEnv,
    StepCounter,
    TerminateTransform,
    TransformedEnv,
    UnaryTransform,
    check_env_specs,
)

from bgpo_trl.modules.behavior_groups import BehaviorGroups
from bgpo_trl.transforms import BehaviorLookup, BehaviorMatchingReward, GroupLookup
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


def test_what_acts_when_episodes_end_has_to_see_where_they_end():
    def make(*transforms, learn=True, base=None, seeds=None):
        lookup = BehaviorLookup(make_modules(seeds)[2], learn=learn)
        parts = Compose(*transforms, lookup)
        return TransformedEnv(base or MockEnv(seeds), parts, auto_unwrap=False), lookup

    def shown():  # a demonstration without a source
        return UnaryTransform(["task"], ["demo_embedding"], fn=lambda task: torch.zeros(32))

    without = r"put StepCounter\(50\) before"
    with pytest.raises(ValueError, match=without):
        make(shown())[0].reset()
    env, lookup = make(shown(), learn=False)
    env.reset()
    lookup.learn = True
    with pytest.raises(ValueError, match=without):
        env.reset()
    counted = lambda: TransformedEnv(MockEnv(), make_source())  # noqa: E731
    rewarded = lambda: with_bonus(make_source())  # noqa: E731
    for within in (counted, rewarded):
        with pytest.raises(ValueError, match=without):
            TransformedEnv(SerialEnv(2, within), StepCounter(50)).reset()
    for late in (StepCounter(5), RandomTruncationTransform(2, 3), TerminateTransform(torch.any)):
        env, _ = make(StepCounter(), make_source())
        env.append_transform(late)
        with pytest.raises(ValueError, match=f"put {type(late).__name__} before"):
            env.reset()

    make(StepCounter(), make_source())[0].reset()  # the environment has a limit of its own
    make(StepCounter(50, step_count_key="time"), make_source())[0].reset()
    limited = TransformedEnv(MockEnv(), StepCounter(50))
    make(make_source(), base=limited)[0].reset()
    make(make_source([0, 1]), base=SerialEnv(2, lambda: limited), seeds=[0, 1])[0].reset()


def with_bonus(source):
    """An environment with an intrinsic reward, which does not see where its episodes end."""
    latent = UnaryTransform(["task"], ["latent"], fn=lambda task: torch.zeros(64))
    same = RenameTransform(["demo_embedding"], ["behavior"], create_copy=True)
    return TransformedEnv(
        MockEnv(), Compose(latent, source, same, BehaviorMatchingReward(make_modules()[1]))
    )


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


def test_groups_are_part_of_the_state_of_an_environment():
    env, groups = make_groups([4, 2])
    adapt(groups, 25)
    new, found = make_groups([4, 2])
    new.load_state_dict(env.state_dict())
    for ours, theirs in zip(found, groups, strict=True):
        assert str(ours.state_dict()) == str(theirs.state_dict()) and len(ours.numbers) > 1


def test_what_trials_read_has_to_be_there():
    lookup = GroupLookup([BehaviorGroups(32)], learn=True, starts=torch.zeros(3, 64))
    with pytest.raises(ValueError, match="found no 'latent': put FrameEncoder before it"):
        compose(lookup, None, 3).reset()
    shown = {"demo_embedding": torch.rand(1, 32), "demo_index": torch.tensor([3])}
    group = torch.zeros(1, dtype=torch.int64)
    step = {"group": group, "group_novelty": torch.zeros(1), "expert": group.clone()}
    step = TensorDict({**shown, **step, "group_fits": torch.ones(1, dtype=torch.bool)}, [1])
    ended = TensorDict({"done": torch.ones(1, 1, dtype=torch.bool)}, [1])
    with pytest.raises(ValueError, match="starts has 3 rows, demonstration 3 was shown"):
        lookup._step(step, ended)
