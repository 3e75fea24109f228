"""A custom pipeline in plain TorchRL: python examples/own_pipeline.py.

A second GWR-B learns the robot's latents and adds a novelty bonus to the reward.
"""

import torch
from tensordict.nn import TensorDictSequential as Seq
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, StepCounter, Transform, TransformedEnv
from torchrl.modules import AdditiveGaussianModule

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate
from bgpo_trl.scenes.nico import NicoEnv
from bgpo_trl.transforms import BehaviorLookup, DemonstrationSource, FrameEncoder, TaskSchedule


class NoveltyReward(Transform):
    """Add ``weight * (1 - activity)`` of a GWR-B that adapts to every latent."""

    def __init__(self, gwr: GWRB, weight: float) -> None:
        super().__init__(in_keys=["latent", "reward"], out_keys=["reward"])
        self.gwr, self.weight = gwr, weight

    def _step(self, tensordict, next_tensordict):
        latent = next_tensordict["latent"] / 8  # scales 64 standardized features to norm 1
        bonus = self.weight * (1 - self.gwr.adapt(latent).activity.unsqueeze(-1))
        return next_tensordict.set("reward", next_tensordict["reward"] + bonus)


if __name__ == "__main__":
    torch.manual_seed(0)
    encoders, bank = load_pretrained()
    behaviors, places = GWRB(32), GWRB(64, GWRBConfig(activity_threshold=0.6), init="data")
    encode = FrameEncoder(encoders.frame_network, del_keys=True)  # pixels -> latent
    source = DemonstrationSource(bank.seen(), TaskSchedule(starts=(0, 2, 4)))
    infer = BehaviorLookup(behaviors, learn=True)  # demo_embedding -> behavior
    reward = NoveltyReward(places, weight=0.01)
    env = TransformedEnv(NicoEnv(seed=0), Compose(encode, StepCounter(50), source, infer, reward))
    actor, critic = Actor(64 + 32), Critic(64 + 32)
    loss = DDPGLoss(actor, critic, return_bounds=(0.0, 1.5))  # 1 + 50 steps of at most 0.01
    optimizer, targets = torch.optim.Adam(loss.parameters()), ForeachSoftUpdate(loss, tau=0.005)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=128)
    explore = AdditiveGaussianModule(env.action_spec, sigma_init=0.3, sigma_end=0.3)
    how = {"frames_per_batch": 200, "total_frames": 1_000, "auto_register_policy_transforms": False}
    for data in Collector(env, Seq(actor, explore), **how):
        replay.extend(data)
        for _ in range(50):
            losses = loss(replay.sample())
            optimizer.zero_grad()
            (losses["loss_actor"] + losses["loss_value"]).backward()
            optimizer.step()
            targets.step()
        print(f"reward {data['next', 'reward'].mean():.4f} a step, {places.num_nodes} places")
    print(f"{source.episode} episodes, {behaviors.num_nodes} behaviors")
