"""A custom baseline, trained and tested like all others: python examples/own_baseline.py."""

from functools import partial

import torch

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.configs import RunConfig
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.representation import encode_frames, valid_steps
from bgpo_trl.runs.results import read_curves
from bgpo_trl.training import Trainer


class NearestNeighbors(Algorithm):
    """k nearest neighbors (Pari et al., 2021): states ``[M, 96]`` with actions ``[M, 4]``."""

    def __init__(self, config, *, states, actions, encoders, **world):
        super().__init__(config, encoders=encoders, **world)
        self.env = self.compose(config, encoders)  # pixels -> latent, and the demonstrations
        self.scale, self.states, self.actions = states.std(0), states / states.std(0), actions

    def choose(self, *seen):
        nearness, row = (-torch.cdist(torch.cat(seen, -1) / self.scale, self.states)).topk(5)
        return (nearness.softmax(-1).unsqueeze(-1) * self.actions[row]).sum(-2)

    def act(self, tensordict):
        action = self.choose(tensordict["latent"], tensordict["demo_embedding"])
        return tensordict.set("action", action)

    def store(self, transition): ...  # There is nothing to update.

    def update(self):
        return {}

    def freeze(self, index, embedding, task, generator):
        return {"demo_embedding": embedding}

    def act_frozen(self, frozen, state):
        return self.choose(state, frozen["demo_embedding"])


if __name__ == "__main__":
    out = "runs/own-baseline"
    shown = record_demonstrations(f"{out}/shown", per_task=10, held_out_per_task=1, seed=1)
    encoders, bank = load_pretrained()
    latent = encode_frames(encoders.vae, shown["pixels"], shown["length"])
    phi = encoders.lae.encode(latent, shown["length"]).unsqueeze(1).expand(-1, 50, -1)
    taken = valid_steps(shown["length"] - 1, 50)  # one action fewer than frames
    states, actions = torch.cat([latent[:, :-1], phi], -1)[taken], shown["action"][taken]
    config = RunConfig(name="knn", seeds=(0,), episodes=1, task_starts=(0, 0, 0), eval_episodes=5)
    make = partial(NearestNeighbors, states=states, actions=actions)
    with Trainer(
        config, f"{out}/run", bank=bank, encoders=encoders, make=make, resume=True
    ) as trainer:
        trainer.run()
    success = read_curves(f"{out}/run/eval.csv", config.tasks).success[0, -1]
    print(config.name, dict(zip(config.tasks, success.tolist(), strict=True)))
