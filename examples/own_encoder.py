"""A frame encoder of your own in place of the VAE: python examples/own_encoder.py.

It is frozen: random convolutions, and where each of their maps is strongest. On the command line,
``bgpo encoders DATASET --import examples.own_encoder --config.frame-network random-places`` trains
the other encoders on its vectors. To see learning rather than its start, raise the numbers below.
"""

from pathlib import Path

import torch
from torch import nn

import bgpo_trl
from bgpo_trl.configs import (
    InverseModelConfig,
    RepresentationConfig,
    RunConfig,
    SequenceAutoencoderConfig,
)
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.fitting import train_representation
from bgpo_trl.encoders.probes import probe
from bgpo_trl.encoders.train import make_bank
from bgpo_trl.modules.frame_network import FRAME_NETWORKS, FrameNetwork
from bgpo_trl.scenes import find_scene
from bgpo_trl.training import Trainer

OUT, TASKS = Path("runs/own-encoder"), ("grasp_glass", "push_green_to_glass")


class RandomPlaces(FrameNetwork):
    """Expected places under the softmax of 32 random maps of a frame, hence 64 numbers.

    `examples/torchvision_encoder.py` does the same with a network of torchvision.
    """

    identity = "random-places 1"  # Change the version if the same weights give other features.

    def __init__(self, frame_shape):
        super().__init__(64, frame_shape)
        self.maps = nn.Sequential(
            nn.Conv2d(3, 32, 5, stride=2, padding=2), nn.ReLU(), nn.Conv2d(32, 32, 5, padding=2)
        )

    def features(self, frames):
        maps = self.maps(frames.permute(0, 3, 1, 2) / 255)
        share = (20 * maps).flatten(2).softmax(-1).view(maps.shape)  # 20: a few pixels have most
        along_columns, along_rows = share.sum(2), share.sum(3)
        height, width = maps.shape[2:]
        x = along_columns @ torch.linspace(-1, 1, width, device=maps.device)
        y = along_rows @ torch.linspace(-1, 1, height, device=maps.device)
        return torch.cat([x, y], -1)


FRAME_NETWORKS["random-places"] = RandomPlaces

if __name__ == "__main__":
    scene = find_scene("nico")
    small = RepresentationConfig(
        frame_network="random-places",
        lae=SequenceAutoencoderConfig(steps=100, batch_size=16),
        inverse=InverseModelConfig(steps=100, batch_size=256, largest_action=scene.largest_action),
    )
    options = {"tasks": TASKS, "held_out_per_task": 4}
    shown = record_demonstrations(OUT / "demonstrations", per_task=24, **options)
    play = record_demonstrations(OUT / "play", per_task=24, play=True, **options)
    encoders = train_representation(shown, small, play=play, scene=scene.identity)
    bank = make_bank(encoders, shown, tasks=TASKS, actions="inferred")
    found = probe(encoders, shown)
    print(f"R2 of inferred actions: {found['inverse_r2']:.2f}")
    print(f"nearest demonstration of the same task: {found['task_accuracy_nearest']:.0%}")

    config = RunConfig(seeds=(0,), episodes=4, tasks=TASKS, task_starts=(0, 2), eval_every=2)
    with Trainer(config, OUT / "run", bank=bank, encoders=encoders, resume=True) as trainer:
        trainer.run()
    policy = bgpo_trl.load_run(OUT / "run")
    frames = shown["pixels"][0, : shown["length"][0]].numpy()
    behavior = policy.condition(frames).node
    print(f"behavior {behavior}, first action {policy.act(frames[0]).round(2)}")
