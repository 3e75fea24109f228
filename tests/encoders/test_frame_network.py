"""A frame network of one's own in place of the VAE: other encoders on its vectors, files, runs."""

import importlib
import json
from dataclasses import replace
from functools import partial

import pytest
import torch

from bgpo_trl.encoders.fitting import train_representation
from bgpo_trl.encoders.representation import (
    encode_frames,
    load_representation,
    save_representation,
    split,
    valid_frames,
    valid_steps,
)
from bgpo_trl.encoders.train import train_encoders
from bgpo_trl.modules.frame_network import FRAME_NETWORKS, FrameNetwork
from bgpo_trl.modules.sequence_autoencoder import SequenceAutoencoder
from tests.helpers import TINY_ENCODERS, noise_demonstrations, rows
from tests.scenes.dot import SavedDot, scene

NAME = "columns"
TINY = replace(TINY_ENCODERS, frame_network=NAME, checkpoint_every=1, log_every=2)
DOT = scene(SavedDot)
OPERATORS = []  # which are there as long as their library


class Columns(FrameNetwork):
    """How bright each column of a frame is, in a random order, after a batch norm that is frozen.

    A batch norm also has a buffer of whole numbers.
    """

    identity = f"{NAME} 1"

    def __init__(self, frame_shape):
        super().__init__(frame_shape[1], frame_shape)
        self.norm = torch.nn.BatchNorm1d(self.latent_size)
        self.register_buffer("order", torch.randperm(self.latent_size))

    def features(self, frames):
        return self.norm(frames.float().mean((1, 3))[:, self.order])


@pytest.fixture(autouse=True)
def registered(restored_registries):
    FRAME_NETWORKS[NAME] = Columns


def shown():
    """Demonstrations of two tasks, 53 frames of them to learn from."""
    dataset = noise_demonstrations([5, 7] * 6, DOT.frame_shape, DOT.action_size, held_out=3)
    return dataset.exclude("state").set("task", torch.arange(12) % 2)


def train(config=TINY, **options):
    options = {"scene": DOT.identity, "progress": False, **options}
    return train_representation(shown(), config, **options)


def test_it_stays_as_it_is_and_its_latents_are_standardized():
    before = torch.get_rng_state()
    encoders = train()
    assert torch.get_rng_state().equal(before)
    network = encoders.frame_network
    assert type(network) is Columns and not network.training
    assert not any(weights.requires_grad for weights in encoders.frame_network.parameters())
    assert network.norm.running_mean.eq(0).all() and network.norm.num_batches_tracked == 0
    learned, _ = split(shown())
    features = network.features(valid_frames(learned))
    latent = encode_frames(network, learned)
    valid = valid_steps(learned["length"], latent.shape[1])
    std = features.std(0)
    expected = (features - features.mean(0)) / std.clamp_min(0.1 * std.max())
    torch.testing.assert_close(latent[valid], expected)
    assert not latent[~valid].any()


def test_what_is_of_the_vae_alone_is_left_out(tmp_path):
    options = {"tasks": DOT.default_tasks, "scene": DOT, "progress": False}
    with pytest.warns(UserWarning) as caught:  # of the other encoders
        train_encoders(shown(), None, tmp_path / "weights", tmp_path, TINY, **options)
    assert not any("reconstruct" in str(warning.message) for warning in caught)
    assert not (tmp_path / "reconstructions.png").exists()
    assert not any(
        "reconstruction" in name for name in json.loads((tmp_path / "probes.json").read_text())
    )
    assert {row["stage"] for row in rows(tmp_path / "train.csv")} == {"lae", "inverse"}


def test_a_file_holds_it_and_its_module_makes_it_again(tmp_path):
    encoders, path = train(), tmp_path / "weights"
    save_representation(encoders, path)
    read = load_representation(path, scene=DOT)
    assert read.identity == encoders.identity and read.metadata == encoders.metadata
    newer = type("Columns", (Columns,), {"identity": f"{NAME} 2"})((16, 24))
    newer.load_state_dict(encoders.frame_network.state_dict())
    assert replace(encoders, frame_network=newer).identity != encoders.identity
    frames = shown()["pixels"]
    assert read.frame_network.latent(frames).equal(encoders.frame_network.latent(frames))
    assert not read.frame_network.training
    with pytest.raises(ValueError, match=r"has frames of \[16, 24\] .* the scene \[16, 26\]"):
        load_representation(path, scene=replace(DOT, frame_shape=(16, 26)))


def import_example():
    """Import the example with a network of torchvision.

    PyPI's torchvision is built for CUDA's torch. Beside a build for CPUs alone, its own operators
    are lacking, which the import expects to be there. No network of convolutions calls them.
    """
    try:
        return importlib.import_module("examples.torchvision_encoder")
    except RuntimeError:
        operators = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        OPERATORS.append(operators)
        return importlib.import_module("examples.torchvision_encoder")


def test_a_network_of_torchvision_comes_back_from_its_file(tmp_path):
    made, path = import_example().ResNet18Places, tmp_path / "file"
    FRAME_NETWORKS["resnet18-places"] = made
    encoders = train(config=replace(TINY, frame_network="resnet18-places"))
    network = encoders.frame_network
    assert type(network) is made and network.latent_size == 128
    save_representation(encoders, path)
    read = load_representation(path, scene=DOT)
    frames = shown()["pixels"][:, 0]
    latent = read.frame_network.latent(frames)
    assert latent.equal(network.latent(frames)) and latent.std(0).min() > 0
    torch.testing.assert_close(read.frame_network.latent(frames[3:4]), latent[3:4])


def test_a_file_whose_network_no_module_adds_or_in_another_version_is_refused(tmp_path, refused):
    path = tmp_path / "weights"
    save_representation(train(), path)
    load = partial(load_representation, path)
    FRAME_NETWORKS[NAME] = type("Columns", (Columns,), {"identity": f"{NAME} 2"})
    refused(load, f"of the frame network '{NAME} 1', the imported module has '{NAME} 2'", "use the")
    del FRAME_NETWORKS[NAME]
    refused(load, f"{path} cannot be loaded: there is no frame network '{NAME}'", "--import")


def test_a_training_on_the_vectors_of_another_network_is_not_resumed(tmp_path):
    first = train(checkpoint=tmp_path)
    assert train(checkpoint=tmp_path).identity == first.identity
    FRAME_NETWORKS[NAME] = type("Columns", (Columns,), {"identity": f"{NAME} 2"})
    with pytest.raises(ValueError, match="another configuration or frame network"):
        train(checkpoint=tmp_path)


class Hidden(Columns):
    """Has a weight that no file would hold."""

    made = 0

    def __init__(self, frame_shape):
        super().__init__(frame_shape)
        Hidden.made += 1
        self.factor = Hidden.made

    def features(self, frames):
        return self.factor * super().features(frames)


def test_what_a_file_would_not_bring_back_is_not_saved(tmp_path, refused):
    FRAME_NETWORKS[NAME] = Hidden
    hidden = train()
    larger = replace(hidden, lae=SequenceAutoencoder(24, 16))
    named = {**hidden.metadata, "frame_network": "rows 1"}
    for encoders, cause in (
        (hidden, "depends on more than parameters and buffers"),
        (larger, "size mismatch"),
        (replace(hidden, metadata=named), "there is no frame network 'rows'"),
        (replace(hidden, metadata={}), "KeyError: 'config'"),
    ):
        save = partial(save_representation, encoders, tmp_path / "weights")
        refused(save, "saved, but not loaded again", cause)


def odd(change):
    """A network whose features are changed."""
    features = {"features": lambda self, frames: change(Columns.features(self, frames))}
    return type("Odd", (Columns,), features)


@pytest.mark.parametrize(
    ("entry", "cause"),
    [
        (None, "no frame network 'columns', only vae: name the module that adds it with"),
        (lambda shape: torch.nn.Linear(3, 4), "made a Linear: derive it from FrameNetwork"),
        (lambda shape: Columns((16, 32)), r"is of frames \[16, 32\], these are \[16, 24\]"),
        (type("Odd", (Columns,), {"identity": "odd 1"}), "identity of Odd is .* got 'odd 1'"),
        (type("Odd", (Columns,), {"identity": NAME}), "such as 'columns 1', got 'columns'"),
        (odd(torch.ones_like), "features of frames are constant or not finite"),
        (odd(lambda f: f[1:]), r"Odd.features\(\) must return \[53, 24\] .*, got \[52, 24\]"),
        (odd(lambda f: f[:, :3]), r"features must be \[N, 24\], N >= 2, got \[53, 3\]"),
    ],
)
def test_what_is_no_frame_network_is_refused_before_training(entry, cause):
    FRAME_NETWORKS[NAME] = entry
    if entry is None:
        del FRAME_NETWORKS[NAME]
    log = []
    with pytest.raises(ValueError, match=cause):
        train(log=log.append)
    assert not log
