"""Networks on another device than the simulation: the same run, to float tolerance.

The other device is one made up for the tests, on which tensors of two devices do not mix, as on a
GPU; a GPU is tested too if there is one.
"""

from contextlib import nullcontext
from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.encoders.fitting import train_representation
from bgpo_trl.encoders.mismatch import doubt_frames
from bgpo_trl.encoders.representation import load_representation, save_representation
from bgpo_trl.modules.frame_network import FRAME_NETWORKS
from bgpo_trl.scenes.nico import NicoEnv
from tests.encoders.test_frame_network import NAME, Columns
from tests.helpers import TINY_ENCODERS, noise_demonstrations, rows
from tests.second_device import second_device

# The first two need data of each task; the last rests after a boundary, with an empty replay.
LONGER = ("maml-demonstrations", "dist-nll-demonstrations", "ewc")


@pytest.fixture(params=["second", *(["cuda"] if torch.cuda.is_available() else [])])
def device(request):
    used = second_device() if request.param == "second" else nullcontext(request.param)
    with used as device:
        yield device


def test_tensors_of_two_devices_do_not_mix():
    """A check of the second device itself."""
    with second_device() as device:
        there, here = torch.ones(2, 3, device=device), torch.arange(3.0)
        for wrong in (lambda: there + here, lambda: torch.stack([there[0], here])):
            with pytest.raises(RuntimeError, match="two devices"):
                wrong()
        with pytest.raises(RuntimeError, match="generator"):
            torch.rand(2, device=device, generator=torch.Generator())


def test_colors_are_doubted_wherever_the_network_is(device, encoders):
    frames = torch.randint(256, (3, 32, 64, 3), generator=torch.Generator().manual_seed(0))
    network, frames = deepcopy(encoders.frame_network), frames.to(torch.uint8)
    assert doubt_frames(network.to(device), frames) == doubt_frames(encoders.frame_network, frames)


def test_an_environment_may_be_moved(device):
    seen = []
    for place in ("cpu", device):
        env = NicoEnv(batch_size=[2], seed=0, observation="state").to(place)
        state = env.reset(TensorDict({"task": torch.tensor([1, 2])}, [2], device=place))
        given = {"action": torch.full((2, 4), 0.5), "_step": torch.tensor([True, False])}
        after = env.step(state.update(TensorDict(given, [2], device=place)))["next"]
        again = TensorDict({"_reset": torch.tensor([[True], [False]])}, [2], device=place)
        again = env.reset(after.update(again))
        assert {entry.device for entry in (*after.values(), *again.values())} == {env.device}
        seen.append(torch.stack([after["state"], again["state"]]).cpu())
    assert torch.equal(*seen)


@pytest.mark.usefixtures("easy_world")
@pytest.mark.parametrize("name", ["bgpo", *LONGER])
def test_a_run_is_the_same_on_every_device(device, name, begin, encoders, make_config, tmp_path):
    config = make_config(name=name, episodes=16 if name in LONGER else 6, eval_every=3)
    try:
        for folder, place in (("here", "cpu"), ("there", device)):
            begin(tmp_path / folder, config, device=place).run()
    finally:
        encoders.frame_network.cpu()
    assert any(float(row["loss_value"]) > 0 for row in rows(tmp_path / "here" / "train.csv"))
    for name in ("train.csv", "eval.csv"):
        here, there = rows(tmp_path / "here" / name), rows(tmp_path / "there" / name)
        for ours, theirs in zip(here, there, strict=True):
            assert (ours["steps"], ours["success"]) == (theirs["steps"], theirs["success"])
            for key in ("return", "intrinsic_return", "loss_actor", "loss_value"):
                if key in ours:
                    assert float(ours[key]) == pytest.approx(float(theirs[key]), abs=1e-3)


@pytest.mark.parametrize("frame_network", ["vae", NAME])
def test_encoders_trained_elsewhere_come_back_to_the_cpu(device, tmp_path, frame_network):
    FRAME_NETWORKS[NAME] = Columns
    config = replace(TINY_ENCODERS, frame_network=frame_network)
    data, found = noise_demonstrations([3] * 4), []
    for place in ("cpu", device):
        trained = train_representation(data, config, scene="noise 1", device=place, progress=False)
        save_representation(trained, tmp_path / "weights.safetensors")
        found.append(load_representation(tmp_path / "weights.safetensors"))
    here, there = found
    # An H200 ends up to 0.004 away, since products of another order round otherwise.
    far = {"rtol": 1e-3, "atol": 1e-2 if device == "cuda" else 1e-3}
    for (_, ours), (_, theirs) in zip(here.networks(), there.networks(), strict=True):
        torch.testing.assert_close(ours.state_dict(), theirs.state_dict(), **far)
