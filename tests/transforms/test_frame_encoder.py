"""FrameEncoder: latents at reset and at every step, only of the rows that need them."""

import pytest
import torch
from torchrl.envs import Compose, Transform, TransformedEnv, check_env_specs

from bgpo_trl.transforms import FrameEncoder
from tests.transforms.environment import MockEnv, TopRow, make_modules, play


@pytest.mark.parametrize(
    ("seeds", "keys", "del_keys"),
    [
        (None, ("pixels", "latent"), False),
        ([4, 2, 3], (("agent", "pixels"), ("agent", "latent")), True),
    ],
)
def test_every_frame_is_encoded_from_the_reset_on(seeds, keys, del_keys):
    vae, in_key, out_key = make_modules()[0], *keys
    encoder = FrameEncoder(vae, in_key, out_key, del_keys=del_keys)
    env = TransformedEnv(MockEnv(seeds, 3, in_key), encoder)
    frames, _ = play(TransformedEnv(MockEnv(seeds, 3, in_key)), 8)
    check_env_specs(env)
    steps, _ = play(env, 8)
    assert (in_key in steps.keys(True)) is not del_keys
    for data, expected in ((steps, frames), (steps["next"], frames["next"])):
        torch.testing.assert_close(data[out_key], vae.latent(expected[in_key]))
    assert frames[in_key].float().std() > 5  # frames that show nothing would prove nothing


def test_partial_reset_encodes_the_rows_that_are_reset_only():
    vae = TopRow()
    env = TransformedEnv(MockEnv([0, 1, 2], [2, 3, 3]), FrameEncoder(vae))
    data = env.reset()
    del vae.n_frames[:]
    steps, data = play(env, 3, data)
    assert vae.n_frames == [3, 3, 1, 3, 2]
    assert data["latent"].equal(vae.latent(data["pixels"]))
    assert steps["latent"].equal(vae.latent(steps["pixels"]))


def test_later_transforms_see_the_latents_of_rows_that_are_not_reset():
    class Witness(Transform):
        def _reset(self, tensordict, tensordict_reset):
            seen.append(tensordict_reset["latent"].clone())
            return tensordict_reset

        def _call(self, next_tensordict):
            seen.append(next_tensordict["latent"].clone())
            return next_tensordict

    seen, vae = [], TopRow()
    transforms = Compose(FrameEncoder(vae, del_keys=True), Witness())
    env = TransformedEnv(MockEnv([0, 1, 2], [2, 3, 3]), transforms)
    start = env.reset()
    del seen[:]
    play(env, 2, start)
    _, stepped, reset = seen
    assert not stepped.equal(start["latent"])
    assert reset[1:].equal(stepped[1:])  # only row 0 has ended
    assert reset[0].equal(start["latent"][0])


def test_partial_step_encodes_the_rows_that_are_stepped_only():
    vae = TopRow()
    env = TransformedEnv(MockEnv([0, 1, 2], 9), FrameEncoder(vae))
    data = env.rand_step(env.reset())["next"]
    before, stepped = data["latent"], torch.tensor([True, False, True])
    del vae.n_frames[:]
    after = env.step(env.rand_action(data).set("_step", stepped))["next"]
    assert vae.n_frames == [2]
    assert after["latent"][stepped].equal(vae.latent(after["pixels"][stepped]))
    assert not after["latent"][stepped].equal(before[stepped])
    assert after["latent"][~stepped].equal(before[~stepped])


def test_records_no_gradient_and_leaves_the_encoder_trainable():
    class Trainable(torch.nn.Linear):
        def latent(self, pixels):
            return self(pixels[..., 0, :, 0].float())

    encoder = Trainable(64, 64)
    env = TransformedEnv(MockEnv(), FrameEncoder(encoder))
    start = env.reset()
    with torch.enable_grad():
        steps = [start, env.rand_step(start)["next"]]
    assert not any(step["latent"].requires_grad for step in steps)
    assert encoder.weight.requires_grad


def test_an_environment_without_these_frames_is_refused():
    vae = make_modules()[0]
    with pytest.raises(ValueError, match=r"found no 'left'.*give the key"):
        _ = TransformedEnv(MockEnv(), FrameEncoder(vae, "left")).observation_spec
