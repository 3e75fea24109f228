"""BehaviorMatchingReward: the trajectory's embedding and the intrinsic reward at its end."""

import math

import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs import (
    Compose,
    RenameTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)

from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.transforms import BehaviorMatchingReward, FrameEncoder
from tests.transforms.environment import MockEnv, make_env, make_modules, play


@pytest.mark.parametrize(("seeds", "beta"), [(None, 0.0), ([4, 2, 3], 0.1)])
def test_an_episode_ends_with_the_embedding_of_its_trajectory_and_its_reward(seeds, beta):
    """By hand, at success and at time-out; with a weight of 0, the reward is measured only."""
    lengths = 4 if seeds is None else [2, 4, 9]  # the last one is cut off after 5
    env = make_env(seeds, lengths, beta=beta)
    check_env_specs(env)
    steps, _ = play(env, 20)
    lae = make_modules()[1]
    rows = [(steps, 4)] if seeds is None else list(zip(steps, [2, 4, 5], strict=True))
    for row, length in rows:
        for start in range(0, 20, length):
            episode = row[start : start + length]
            after = episode["next"]
            # z_0 ... z_T, the last one included
            trajectory = torch.cat([episode["latent"][:1], after["latent"]])
            phi = lae.encode(trajectory, torch.tensor(length + 1))
            torch.testing.assert_close(after["lae_h"][-1], phi)
            at_start = lae.encode(trajectory[:1], torch.tensor(1))
            torch.testing.assert_close(episode["lae_h"][0], at_start)

            last = torch.arange(length).unsqueeze(-1) == length - 1
            bonus = last * torch.exp(-(after["behavior"][-1] - phi).square().sum().sqrt())
            assert after["done"].equal(last)
            assert after["extrinsic_reward"].equal((last & (length < 5)).float())
            torch.testing.assert_close(after["intrinsic_reward"], bonus)
            torch.testing.assert_close(after["reward"], after["extrinsic_reward"] + beta * bonus)
    assert steps["next", "intrinsic_reward"].max() > 1e-4


def test_an_end_is_rewarded_once():
    env = make_env([0, 1], [2, 4])
    data = env.reset()
    rewarded = torch.zeros(2, 1)
    for _ in range(7):  # stepping on without a reset
        data = env.step(data.set("action", torch.zeros(2, 4)))
        rewarded += data["next", "intrinsic_reward"] > 0
        data = env.step_mdp(data)
    assert rewarded.tolist() == [[1], [1]]


def test_wrong_orders_are_refused():
    vae = make_modules()[0]

    def reset(*transforms):
        env = TransformedEnv(MockEnv(), Compose(FrameEncoder(vae), StepCounter(50)))
        for transform in transforms:  # each around the one before
            env = TransformedEnv(env, transform, auto_unwrap=False)
        env.reset()

    def behavior():  # the latent itself: all that matters here is the order
        return RenameTransform(["latent"], ["behavior"], create_copy=True)

    def bonus():
        return BehaviorMatchingReward(SequenceAutoencoder(embedding_size=64))

    with pytest.raises(ValueError, match="put BehaviorLookup before it"):
        reset(bonus())
    refusal = "put RewardSum after BehaviorMatchingReward"
    with pytest.raises(ValueError, match=refusal):
        reset(behavior(), Compose(RewardSum(), bonus()))
    with pytest.raises(ValueError, match=refusal):
        reset(Compose(behavior(), RewardSum()), bonus())
    within = TransformedEnv(
        MockEnv(), Compose(FrameEncoder(vae), behavior(), StepCounter(50), RewardSum())
    )
    with pytest.raises(ValueError, match=refusal):
        TransformedEnv(SerialEnv(1, lambda: within), bonus()).reset()
    reset(behavior(), Compose(bonus(), RewardSum()))


@pytest.mark.parametrize("use_buffers", [True, False])
def test_each_worker_can_have_a_composition_of_its_own(use_buffers):
    workers = [lambda: make_env(lengths=9), lambda: make_env(lengths=4)]
    env = SerialEnv(2, workers, use_buffers=use_buffers)
    check_env_specs(env)
    together, _ = play(env, 12)
    alone, _ = play(make_env(lengths=4), 12)
    for key, value in together[1].items(True, True):
        torch.testing.assert_close(alone[key], value)


def test_rows_that_are_not_stepped_keep_their_embedding():
    env = make_env([0, 1], lengths=9)
    before = env.reset()
    before["action"] = torch.full((2, 4), 0.5)
    before["_step"] = torch.tensor([True, False])
    after = env.step(before.clone())["next"]
    for key in ("lae_h", "lae_c"):
        assert not after[key][0].equal(before[key][0])
        assert after[key][1].equal(before[key][1])


class Silenced(MockEnv):
    """Pays whole numbers, or hides the last latent of an episode, as one that resets itself."""

    def __init__(self, reward):
        super().__init__(lengths=2)
        self.reward = reward
        self.observation_spec["latent"] = Unbounded(64)
        if reward == torch.int64:
            self.reward_spec = Unbounded(1, dtype=torch.int64)

    def _observe(self, action):
        hidden = self.steps >= self.lengths and self.reward == torch.float32
        return super()._observe(action).set("latent", torch.full([64], math.nan if hidden else 0.5))

    def _step(self, tensordict):
        data = super()._step(tensordict)
        return data.set("reward", data["reward"].to(self.reward))


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (torch.int64, r"rewards are torch\.int64: put DTypeCastTransform before"),
        (
            torch.float32,
            r"end of an episode is NaN or Inf, as .* resets itself",
        ),
    ],
)
def test_a_bonus_that_would_be_lost_is_refused(reward, message):
    behavior = RenameTransform(["latent"], ["behavior"], create_copy=True)
    bonus = BehaviorMatchingReward(SequenceAutoencoder(embedding_size=64))
    env = TransformedEnv(Silenced(reward), Compose(StepCounter(50), behavior, bonus))
    with pytest.raises(ValueError, match=message):
        env.rollout(3)
