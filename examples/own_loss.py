"""A custom loss in place of that of DDPG: python examples/own_loss.py."""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tensordict import TensorDictBase
from torch import Tensor

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.rl import RL, Learner, LearnerSpec, RLEntry
from bgpo_trl.configs import DDPGConfig, RunConfig
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.modules.actor_critic import Actor
from bgpo_trl.objectives.ddpg import OffPolicyLoss
from bgpo_trl.training import Trainer


class AdvantageWeightedLoss(OffPolicyLoss):
    """Regression to replayed actions, weighted by their advantage (AWAC; Nair et al., 2020)."""

    def next_value(self, successor: TensorDictBase) -> Tensor:
        data = self.call_network("target_actor_network", successor)
        return self.values("target_value_network", data)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        data = self.call_network("actor_network", self.current(tensordict))
        error = (data["action"] - tensordict["action"]).square().mean(-1)
        replayed = self.values("value_network", tensordict.copy())
        advantage = replayed - self.values("value_network", data)
        weight = (advantage.detach() / 0.1).exp().clamp(max=20)
        return self.reduce(weight * error, tensordict), {}


@dataclass(frozen=True)
class AWACConfig(DDPGConfig):
    """The settings of DDPG under another name."""

    name: str = "awac"


def make(config: AWACConfig, spec: LearnerSpec) -> Learner:
    """Return a learner with DDPG's networks, exploration and optimizer."""
    actor, options = spec.actor(Actor, config), spec.loss_options(config)
    loss = AdvantageWeightedLoss(actor, spec.critic(config), **options)
    return Learner(actor, loss, config, noise=config.noise)


RL["awac"] = RLEntry(make, AWACConfig())

if __name__ == "__main__":  # ground truth and the task label keep this to a minute
    base = replace(ALGORITHMS["oracle"].config, state="state", rl=AWACConfig(warmup_steps=64))
    config = RunConfig((0,), 4, task_starts=(0, 0, 0), eval_every=2, name="oracle", algorithm=base)
    with TemporaryDirectory() as folder, Trainer(config, folder, bank=load_pretrained()[1]) as run:
        run.run()
        print((Path(folder) / "eval.csv").read_text())
