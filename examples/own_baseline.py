"""A custom baseline, trained and tested like all others: python examples/own_baseline.py."""

from functools import partial

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import RenameTransform

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.configs import RunConfig
from bgpo_trl.data.recording import record_demonstrations
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.encoders.representation import encode_frames, valid_steps
from bgpo_trl.runs.results import read_run
from bgpo_trl.training import Trainer


class NearestNeighbors(Algorithm):
    """k nearest neighbors (Pari et al., 2021): states ``[M, 96]`` with actions ``[M, 4]``."""

    conditioning = (RenameTransform(["demo_embedding"], ["context"], create_copy=True),)
    needs_label = False

    def __init__(self, config, *, states, actions, **others):
        super().__init__(config, **others)
        self.scale, self.states, self.actions = states.std(0), states / states.std(0), actions
        self.test_actor = TensorDictModule(self.choose, ["latent", "context"], ["action"])

    def choose(self, latent, demonstration):
        state = torch.cat([latent, demonstration], -1) / self.scale
        nearness, row = (-torch.cdist(state, self.states)).topk(5)
        return (nearness.softmax(-1).unsqueeze(-1) * self.actions[row]).sum(-2)

    def act(self, td):
        return td.set("action", self.choose(td["latent"], td["context"]))

    def store(self, transition): ...  # There is nothing to update.

    def update(self):
        return {}

    def snapshot(self, index, embedding, task, generator):
        return self.policy({}, self.condition(index, embedding, task)["context"])


if __name__ == "__main__":
    out = "runs/own-baseline"
    shown = record_demonstrations(f"{out}/shown", per_task=10, held_out_per_task=1, seed=1)
    encoders, bank = load_pretrained()
    latent = encode_frames(encoders.frame_network, shown)
    phi = encoders.lae.encode(latent, shown["length"]).unsqueeze(1).expand(-1, 50, -1)
    taken = valid_steps(shown["length"] - 1, 50)  # one action fewer than frames
    states, actions = torch.cat([latent[:, :-1], phi], -1)[taken], shown["action"][taken]
    config = RunConfig(name="knn", seeds=(0,), episodes=1, task_starts=(0, 0, 0), eval_episodes=5)
    make = partial(NearestNeighbors, states=states, actions=actions)
    with Trainer(config, f"{out}/run", bank=bank, encoders=encoders, make=make, resume=True) as run:
        run.run()
    success = read_run(f"{out}/run").success[0, -1]
    print(config.name, dict(zip(config.tasks, success.tolist(), strict=True)))
