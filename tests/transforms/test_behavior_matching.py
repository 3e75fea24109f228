"""BehaviorMatchingReward: the trajectory's embedding and the intrinsic reward at its end."""

import pytest
import torch
from torchrl.envs import (
    Compose,
    RenameTransform,
    RewardSum,
    TransformedEnv,
    check_env_specs,
)

from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from bgpo_trl.transforms import BehaviorMatchingReward, FrameEncoder
from tests.transforms.environment import MockEnv, make_env, make_modules, play


@pytest.mark.parametrize("seeds", [None, [4, 2, 3]])
def test_the_lstm_state_is_the_embedding_of_the_trajectory_so_far(seeds):
    lengths = 4 if seeds is None else [2, 4, 9]  # the last one is cut off after 5
    env = make_env(seeds, lengths)
    check_env_specs(env)
    steps, _ = play(env, 20)
    lae = make_modules()[1]
    rows = [(steps, 4)] if seeds is None else list(zip(steps, [2, 4, 5], strict=True))
    for row, length in rows:
        for start in range(0, 20, length):
            episode = row[start : start + length]
            # z_0 ... z_T, the last one included
            trajectory = torch.cat([episode["latent"][:1], episode["next", "latent"]])
            phi = lae.encode(trajectory, torch.tensor(length + 1))
            torch.testing.assert_close(episode["next", "lae_h"][-1], phi)
            at_start = lae.encode(trajectory[:1], torch.tensor(1))
            torch.testing.assert_close(episode["lae_h"][0], at_start)


def test_reward_by_hand_at_success_and_at_time_out():
    env = make_env([0, 1], lengths=[3, 9], max_steps=5, beta=0.1)
    steps, _ = play(env, 15)
    after = steps["next"]
    for row, length, success in ((0, 3, 1.0), (1, 5, 0.0)):
        for t in range(15):
            data = after[row, t]
            last = (t + 1) % length == 0
            phi = data["lae_h"]
            error = sum((b - p) ** 2 for b, p in zip(data["behavior"], phi, strict=True))
            intrinsic = torch.exp(-(error**0.5)) if last else torch.tensor(0.0)
            assert data["done"].item() is last
            assert data["extrinsic_reward"].item() == (success if last else 0.0)
            torch.testing.assert_close(data["intrinsic_reward"], intrinsic.unsqueeze(0))
            torch.testing.assert_close(
                data["reward"], data["extrinsic_reward"] + 0.1 * data["intrinsic_reward"]
            )
    assert after["terminated"][1].sum() == 0  # row 1 never succeeds, yet is rewarded
    assert (after["intrinsic_reward"][1, 4::5] > 1e-4).all()


def test_with_beta_zero_the_intrinsic_reward_is_measured_only():
    plain, weighted = (play(make_env(beta=beta), 8)[0]["next"] for beta in (0.0, 0.5))
    assert plain["reward"].equal(plain["extrinsic_reward"])
    assert plain["intrinsic_reward"].equal(weighted["intrinsic_reward"])
    assert (weighted["reward"] > plain["reward"]).sum() == 2  # the two ends


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
        env = TransformedEnv(MockEnv(), FrameEncoder(vae))
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
    reset(behavior(), Compose(bonus(), RewardSum()))


def test_rows_that_are_not_stepped_keep_their_embedding():
    env = make_env([0, 1], lengths=9)
    before = env.reset()
    before["action"] = torch.full((2, 4), 0.5)
    before["_step"] = torch.tensor([True, False])
    after = env.step(before.clone())["next"]
    for key in ("lae_h", "lae_c"):
        assert not after[key][0].equal(before[key][0])
        assert after[key][1].equal(before[key][1])
