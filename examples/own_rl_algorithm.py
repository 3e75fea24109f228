"""A custom RL algorithm in place of DDPG: TD3 with epsilon-greedy exploration.

python examples/own_rl_algorithm.py
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from bgpo_trl.algorithms.twin_critics import TD3Learner, make_td3
from torch import Tensor

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.rl import RL, LearnerSpec, RLEntry
from bgpo_trl.configs import RunConfig, TD3Config
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.training import Trainer


@dataclass(frozen=True)
class EpsilonConfig(TD3Config):
    """`TD3Config` with its own name and an additional field."""

    name: str = "td3-epsilon"
    epsilon: float = 0.2


class EpsilonLearner(TD3Learner):
    """TD3 with another exploration; overriding `learn` would change how it learns."""

    config: EpsilonConfig

    def explore(self, action: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Return TD3's actions ``[S, 4]``, each random with probability epsilon."""
        action = super().explore(action, generators)
        for row, generator in zip(action, generators, strict=True):  # one generator per seed
            if torch.rand((), generator=generator) < self.config.epsilon:
                row.uniform_(-1, 1, generator=generator)
        return action


def make(config: EpsilonConfig, spec: LearnerSpec) -> EpsilonLearner:
    """Return a learner with the networks and the loss of TD3."""
    td3 = make_td3(config, spec)
    return EpsilonLearner(td3.actor, td3.loss, config)


RL["td3-epsilon"] = RLEntry(make, EpsilonConfig())

if __name__ == "__main__":
    # Ground truth and the task label keep this to a minute. For BGPO, use BGPOConfig(rl=...).
    own = replace(ALGORITHMS["oracle"].config, state="state", rl=EpsilonConfig(warmup_steps=64))
    config = RunConfig((0, 1), 4, task_starts=(0, 0, 0), eval_every=2, name="oracle", algorithm=own)
    with TemporaryDirectory() as folder, Trainer(config, folder, bank=load_pretrained()[1]) as run:
        run.run()
        print((Path(folder) / "eval.csv").read_text())
