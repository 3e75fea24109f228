"""A custom loss in place of that of DDPG: python examples/own_loss.py."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tensordict import TensorDictBase
from torch import Tensor

from bgpo_trl.algorithms import ALGORITHMS, Entry
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.algorithms.rl import Learner, LearnerSpec
from bgpo_trl.configs import RLConfig, RunConfig
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.objectives.ddpg import DDPGLoss
from bgpo_trl.training import Trainer


class AdvantageWeightedLoss(DDPGLoss):
    """Regression to replayed actions, weighted by their advantage (AWAC; Nair et al., 2020)."""

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        data = self.call_network("actor_network", self.current(tensordict))
        error = (data["action"] - tensordict["action"]).square().mean(-1)
        replayed = self.values("value_network", tensordict.copy())
        advantage = replayed - self.values("value_network", data)
        weight = (advantage.detach() / 0.1).exp().clamp(max=20)
        return self.reduce(weight * error, tensordict), {}


class AWAC(BGPO):
    """BGPO with this loss, and with DDPG's networks, exploration and optimizer."""

    def make_learner(self, spec: LearnerSpec) -> Learner:
        rl = self.config.rl
        actor, critic = spec.actor(rl), spec.critic(rl)
        loss = AdvantageWeightedLoss(actor, critic, **spec.loss_options(rl))
        return Learner(actor, {"": "actor_network_params"}, loss, rl)


# Ground truth and the task label keep this to a minute.
small = replace(ALGORITHMS["oracle"].config, state="state", rl=RLConfig(warmup_steps=64))
ALGORITHMS["awac"] = Entry(AWAC, small)

if __name__ == "__main__":
    config = RunConfig((0,), 4, task_starts=(0, 0, 0), eval_every=2, name="awac", algorithm=small)
    with TemporaryDirectory() as folder, Trainer(config, folder, bank=load_pretrained()[1]) as run:
        run.run()
        print((Path(folder) / "eval.csv").read_text())
