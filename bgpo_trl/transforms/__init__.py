"""TorchRL transforms that turn an environment into BGPO's."""

from bgpo_trl.transforms.behavior_matching import BehaviorMatchingReward
from bgpo_trl.transforms.demonstration_source import DemonstrationSource, TaskSchedule
from bgpo_trl.transforms.frame_encoder import FrameEncoder
from bgpo_trl.transforms.lookup import BehaviorLookup, GroupLookup

__all__ = [
    "BehaviorLookup",
    "BehaviorMatchingReward",
    "DemonstrationSource",
    "FrameEncoder",
    "GroupLookup",
    "TaskSchedule",
]
