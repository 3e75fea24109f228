"""A network of torchvision as a frozen frame encoder: where its maps are strongest.

``bgpo encoders DATASET --import examples.torchvision_encoder --config.frame-network
resnet18-places`` trains the other encoders on its vectors. It needs ``pip install torchvision``, of
the version made for the installed torch.
"""

import torch
from torch import Tensor
from torchvision.models import ResNet18_Weights, resnet18

from bgpo_trl.modules.frame_network import FRAME_NETWORKS, FrameNetwork

WEIGHTS: ResNet18_Weights | None = None  # ResNet18_Weights.DEFAULT: ImageNet's, downloaded once


class ResNet18Places(FrameNetwork):
    """Where each map of ResNet-18's first stage is strongest in a frame: two numbers a map.

    The usual mean over the places, before the last layer, would leave out where things are, which
    a robot has to know.
    """

    identity = "resnet18-places 1"  # Change the version if the same weights give other features.

    mean: Tensor
    std: Tensor

    def __init__(self, frame_shape):
        network = resnet18(weights=WEIGHTS)
        super().__init__(2 * network.layer2[0].conv1.in_channels, frame_shape)
        self.first_stage = torch.nn.Sequential(
            network.conv1, network.bn1, network.relu, network.maxpool, network.layer1
        )
        self.register_buffer("mean", torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1))
        self.register_buffer("std", torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1))

    def features(self, frames):
        colors = (frames.permute(0, 3, 1, 2) / 255 - self.mean) / self.std
        maps = self.first_stage(colors)
        share = maps.flatten(2).softmax(-1).view(maps.shape)
        height, width = maps.shape[2:]
        x = share.sum(2) @ torch.linspace(-1, 1, width, device=maps.device)
        y = share.sum(3) @ torch.linspace(-1, 1, height, device=maps.device)
        return torch.cat([x, y], -1)


FRAME_NETWORKS["resnet18-places"] = ResNet18Places
