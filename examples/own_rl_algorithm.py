"""A custom RL algorithm in place of DDPG: DDPG with epsilon-greedy exploration.

python examples/own_rl_algorithm.py
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from bgpo_trl.algorithms import ALGORITHMS, Entry
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.algorithms.rl import Learner, LearnerSpec, make_learner
from bgpo_trl.configs import BGPOConfig, RLConfig, RunConfig
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.training import Trainer


@dataclass(frozen=True)
class EpsilonRLConfig(RLConfig):
    """`RLConfig` with an additional field."""

    epsilon: float = 0.2


@dataclass(frozen=True)
class EpsilonConfig(BGPOConfig):
    """`BGPOConfig` with these settings of the learner."""

    rl: EpsilonRLConfig = field(default_factory=EpsilonRLConfig)


class EpsilonLearner(Learner):
    """DDPG with another exploration; overriding `learn` would change how it learns."""

    config: EpsilonRLConfig

    def explore(self, action: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """Return DDPG's actions ``[S, 4]``, each random with probability epsilon."""
        action = super().explore(action, generators)
        for row, generator in zip(action, generators, strict=True):  # one generator per seed
            if torch.rand((), generator=generator) < self.config.epsilon:
                row.uniform_(-1, 1, generator=generator)
        return action


class EpsilonBGPO(BGPO):
    """BGPO with this learner."""

    def make_learner(self, spec: LearnerSpec) -> Learner:
        """Return a learner with the networks and the loss of DDPG."""
        ddpg = make_learner(self.config.rl, spec)
        return EpsilonLearner(ddpg.policy, ddpg.sources, ddpg.loss, self.config.rl)


# Ground truth and the task label keep this to a minute.
oracle = replace(ALGORITHMS["oracle"].config, state="state", rl=EpsilonRLConfig(warmup_steps=64))
ALGORITHMS["epsilon"] = Entry(EpsilonBGPO, EpsilonConfig(**vars(oracle)))

if __name__ == "__main__":
    own = ALGORITHMS["epsilon"].config
    config = RunConfig(
        (0, 1), 4, task_starts=(0, 0, 0), eval_every=2, name="epsilon", algorithm=own
    )
    with TemporaryDirectory() as folder, Trainer(config, folder, bank=load_pretrained()[1]) as run:
        run.run()
        print((Path(folder) / "eval.csv").read_text())
