"""One seed for simulation, demonstrations and GWR-B, alone and in workers."""

import copy

import pytest
import torch
from torchrl.envs import Compose, SerialEnv, StepCounter, TransformedEnv

from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.scenes.nico import NicoEnv
from bgpo_trl.transforms import BehaviorLookup, DemonstrationSource, TaskSchedule
from tests.transforms.environment import make_bank

DRAWN = ("state", "demo_index", "behavior")  # by simulation, DemonstrationSource and GWR-B


def compose(batch_size=(), max_steps=50):
    return TransformedEnv(
        NicoEnv(batch_size=batch_size, seed=None, observation="state"),
        Compose(
            StepCounter(max_steps),
            DemonstrationSource(make_bank(), TaskSchedule((0, 0, 0)), batch_size=batch_size),
            BehaviorLookup(GWRB(32, batch_size=batch_size), learn=True),
        ),
    )


def rollout(env, n_steps=3):
    """Return a rollout of zero actions, within one episode unless the limit is shorter."""
    action = torch.zeros(*env.batch_size, 4)

    def rest(tensordict):
        return tensordict.set("action", action)

    return env.rollout(n_steps, rest, break_when_any_done=False)


@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_the_same_seed_gives_the_same_episode_and_another_seed_another(batch_size):
    env, other = compose(batch_size), compose(batch_size)
    env.set_seed(7)
    first = rollout(env)
    env.set_seed(7)
    again = rollout(env)
    other.set_seed(7)
    elsewhere = rollout(other)
    env.set_seed(17)
    different = rollout(env)
    assert (first == again).all()
    assert (first == elsewhere).all()
    for key in DRAWN:
        assert not first[key].equal(different[key])


def test_a_row_has_the_seed_counted_up_to_it():
    batch, alone = compose((2,)), compose()
    batch.set_seed(7)
    alone.set_seed(8)
    assert (rollout(batch)[1] == rollout(alone)).all()


def test_a_seed_does_not_undo_what_was_learned():
    env = compose((2,), max_steps=2)
    source, gwr = env.transform[1], env.transform[2].network
    env.set_seed(7)
    rollout(env, 6)
    learned = [gwr.graph(row).weights for row in range(2)]
    assert source.episode.tolist() == [3, 3]
    env.set_seed(7)
    env.reset()
    assert source.episode.tolist() == [0, 0]
    for row in range(2):
        assert gwr.graph(row).weights.equal(learned[row])


def test_a_state_loaded_after_the_seed_was_set_is_kept():
    env, other = compose(), compose()
    state = copy.deepcopy(other.state_dict())
    env.set_seed(7)
    env.load_state_dict(state)
    for key in ("demo_index", "behavior"):
        assert env.reset()[key].equal(other.reset()[key])


def test_environments_side_by_side_draw_differently():
    env = SerialEnv(2, [compose, compose])
    env.set_seed(0)
    first = rollout(env)
    for key in DRAWN:
        assert not first[key][0].equal(first[key][1])
    env.set_seed(0)
    assert (rollout(env) == first).all()
