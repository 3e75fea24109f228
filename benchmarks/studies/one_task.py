"""One task, one group: what the learner makes of N demonstrations and reward, and why.

Eight simulations share one learner, so that a trial of 1,000 episodes takes minutes. The N
demonstrations are there from the start, with frames encoded and actions inferred as in every run.
A clone imitates them for 3,000 updates before the first episode, and plays the first
``clone_episodes`` episodes and one in ``1 / clone_share`` later ones. Tests are of the same 100
new starts each time, without noise.

    python benchmarks/studies/one_task.py --task grasp_glass --demonstrations 30
    python benchmarks/studies/one_task.py --rl.critics 2 --rl.gamma 0.99
    python benchmarks/studies/one_task.py --reward 0   # what critics choose without a reward
    python benchmarks/studies/one_task.py --gate       # can critics tell success from failure?

With ``--gate``, the clone plays 200 episodes, from which critics learn its values. For 100 others,
from other starts, the table shows how well the lowest value tells, some steps after the start,
episodes that will succeed from those that will not (area under the ROC curve), and its mean beside
the mean return.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy.stats import mannwhitneyu
from tensordict import TensorDict
from torch import Tensor
from torch.func import functional_call
from torchrl.envs import Compose, StepCounter, TransformedEnv

from bgpo_trl.algorithms.observation import bound, encode
from bgpo_trl.algorithms.rl import LearnerSpec, make_learner
from bgpo_trl.configs import SHOWN, BGPOConfig, RLConfig
from bgpo_trl.data.demonstration_replay import DemonstrationReplay
from bgpo_trl.data.replay import GroupReplay
from bgpo_trl.encoders.pretrained import load_pretrained
from bgpo_trl.experiments.command_line import command_line
from bgpo_trl.scenes import find_scene
from bgpo_trl.seeding import generators, normal, stream_seed

N_SIMULATIONS = 8
N_IMITATION = 3_000
GATE_STEPS = (0, 5, 10, 15, 20)


@dataclass
class Arguments:
    """Settings of a trial."""

    task: str = "grasp_glass"
    """Name of the task."""
    demonstrations: int = 300
    """Number of demonstrations."""
    episodes: int = 1_000
    """Training episodes."""
    seed: int = 0
    """Seed of everything that is drawn."""
    tests: int = 100
    """Episodes of a test."""
    test_every: int = 100
    """Training episodes between tests."""
    updates: float = 1.0
    """Updates per step of a simulation."""
    share: float = 0.5
    """Share of demonstrations in an update."""
    reward: float = 1.0
    """Reward of a success, of demonstrations too; 0 for none."""
    gate: bool = False
    """Whether to measure the critics of the clone instead."""
    out: Path | None = None
    """CSV file to write."""
    rl: RLConfig = field(default_factory=lambda: SHOWN)
    """The learner."""


class Trial:
    """A learner, its demonstrations and its replay."""

    def __init__(self, arguments: Arguments) -> None:
        self.arguments, rl, seed = arguments, arguments.rl, arguments.seed
        self.encoders, bank = load_pretrained()
        self.scene = find_scene("nico")
        bank = bank.for_tasks([arguments.task]).seen(arguments.demonstrations)
        spec = LearnerSpec([seed], ["latent"], 64, (0.0, 1.0), torch.device("cpu"))
        self.learner = make_learner(rl, spec)
        steps = {"n_steps": rl.n_steps, "gamma": rl.gamma}
        self.shown = DemonstrationReplay(
            bank, generator=generators([seed], "demonstration replay"), **steps
        )
        for row in range(len(bank.task)):
            shown = TensorDict({"demo_index": torch.tensor([row])}, [1])
            self.shown.add(shown, torch.full([1], arguments.reward), torch.zeros(1).long())
        self.replay = GroupReplay(
            100_000,
            generator=[generators([seed], f"replay {i}")[0] for i in range(N_SIMULATIONS)],
            keys=["latent", "action"]
            + [("next", key) for key in ("latent", "reward", "terminated", "done")],
            **steps,
        )
        self.noise = [generators([seed], f"exploration {i}")[0] for i in range(N_SIMULATIONS)]
        self.alone = torch.zeros(N_SIMULATIONS, dtype=torch.bool)
        self.n_updates = 0
        self.rows: list[dict[str, object]] = []

    def env(self, n_episodes: int, seed: int) -> TransformedEnv:
        """Return simulations ``[n_episodes]`` of the task, with latents."""
        simulation = self.scene.simulate(
            [self.arguments.task],
            batch_size=[n_episodes],
            seed=[(seed + row) % 2**32 for row in range(n_episodes)],
            observation="pixels",
        )
        config = BGPOConfig()
        transforms = Compose([encode(config, self.encoders), StepCounter(50), *bound(config)])
        return TransformedEnv(simulation, transforms)

    @torch.no_grad()
    def act(self, latent: Tensor, alone: Tensor, *, averaged: bool = False) -> Tensor:
        """Return actions ``[N, 4]``, those of the clone where it is ``alone`` ``[N]``."""
        first = torch.zeros((), dtype=torch.int64)
        action = torch.empty(len(latent), 4)
        for cloned in alone.unique():
            rows = alone == cloned
            weights = self.learner.policy_weights(first, first, cloned, averaged=averaged)
            data = TensorDict({"latent": latent[rows]}, [int(rows.sum())])
            action[rows] = functional_call(self.learner.policy, weights, (data,))["action"]
        return action

    def imitate(self) -> None:
        """Train the clone; the actor then starts as the clone."""
        loss = self.learner.loss
        optimizer = torch.optim.Adam([*loss.clone_network_params.parameters()], lr=1e-3)
        for _ in range(N_IMITATION):
            distance = loss.loss_clone(self.batch(128, 0)).sum()
            optimizer.zero_grad()
            distance.backward()
            optimizer.step()
        for params in (loss.actor_network_params, loss.target_actor_network_params):
            params.data.copy_(loss.clone_network_params.data)

    def batch(self, n_shown: int, n_played: int) -> TensorDict:
        """Draw transitions ``[1, 1, B]``, and as many demonstrated actions to imitate."""
        n_rows = n_shown + n_played
        batch = self.shown.draw(torch.zeros(1, 1, n_shown).long())
        if n_played:
            group = torch.zeros(N_SIMULATIONS, n_played // N_SIMULATIONS).long()
            played = self.replay.draw(group)
            batch = {
                key: torch.cat([value, played[key].reshape(1, 1, -1, *value.shape[3:])], 2)
                for key, value in batch.items()
            }
        imitated = self.shown.draw_actions(torch.zeros(1, 1, n_rows).long())
        batch |= {("imitation", key): value for key, value in imitated.items()}
        return TensorDict(batch, [1, 1, n_rows])

    def update(self) -> None:
        """Make an update of the learner."""
        size = self.arguments.rl.batch_size
        n_played = round((1 - self.arguments.share) * size) // N_SIMULATIONS * N_SIMULATIONS
        self.learner.learn(self.batch(size - n_played, n_played))
        self.n_updates += 1

    def play(
        self, n_episodes: int, *, learn: bool = False, store: bool = True, starts: str = "env"
    ) -> list[tuple[list[Tensor], bool]]:
        """Play training episodes; return latents and actions of each, and whether it succeeded.

        Args:
            n_episodes: Number of episodes.
            learn: Whether to learn and test meanwhile.
            store: Whether to add transitions to the replay.
            starts: Stream of the start states.
        """
        arguments, rl, owed, tested = self.arguments, self.arguments.rl, 0.0, 0
        env = self.env(N_SIMULATIONS, stream_seed(arguments.seed, starts))
        state, episodes, n_begun = env.reset(), [], N_SIMULATIONS
        steps: list[list[Tensor]] = [[] for _ in self.noise]
        while len(episodes) < n_episodes:
            action = self.act(state["latent"], self.alone)
            action = (action + rl.noise * normal(self.noise, [4])).clamp(-1, 1)
            for row, taken in enumerate(torch.cat([state["latent"], action], -1)):
                steps[row].append(taken)
            transition, state = env.step_and_maybe_reset(state.set("action", action))
            transition["next", "reward"] *= arguments.reward
            if store:
                self.replay.add(transition, torch.zeros(N_SIMULATIONS).long())
            for row in transition["next", "done"].flatten().nonzero().flatten().tolist():
                episodes.append((steps[row], bool(transition["next", "success"][row])))
                steps[row] = []
                if learn:
                    later = n_begun - rl.clone_episodes
                    due = rl.clone_share > 0 and later % round(1 / rl.clone_share) == 0
                    self.alone[row] = rl.proposals == "both" and (later < 0 or due)
                n_begun += 1
            if not learn or len(self.replay) * N_SIMULATIONS < rl.warmup_steps:
                continue
            owed += arguments.updates * N_SIMULATIONS
            while owed >= 1:
                self.update()
                owed -= 1
            if len(episodes) // arguments.test_every > tested:
                tested = len(episodes) // arguments.test_every
                self.report(len(episodes))
        env.close()
        return episodes

    @torch.no_grad()
    def report(self, episodes: int, *, alone: bool = False) -> None:
        """Test the policy, or the clone alone, and print a row."""
        n_tests = self.arguments.tests
        env = self.env(n_tests, stream_seed(self.arguments.seed, "evaluation"))
        state, active = env.reset(), torch.ones(n_tests, dtype=torch.bool)
        success, steps = torch.zeros_like(active), torch.zeros(n_tests)
        alone_in_all = torch.full([n_tests], alone)
        averaged = self.n_updates > 0  # Averages begin with the first update, after the imitation.
        while active.any():
            state["action"] = self.act(state["latent"], alone_in_all, averaged=averaged)
            state = env.step(state.set("_step", active))["next"]
            steps += active
            success |= state["success"].flatten() & active
            active = active & ~state["done"].flatten()
        env.close()
        self.rows.append(
            {
                "task": self.arguments.task,
                "demonstrations": self.arguments.demonstrations,
                "seed": self.arguments.seed,
                "episodes": episodes,
                "policy": "clone" if alone else self.arguments.rl.proposals,
                "success": success.float().mean().item(),
                "steps": steps[success].mean().item(),
                "updates": self.n_updates,
            }
        )
        print(*self.rows[-1].values(), flush=True)

    def gate(self) -> None:
        """Measure how well critics of the clone tell success from failure ahead of time."""
        self.alone[:] = True
        self.play(200)
        held_out = self.play(100, store=False, starts="held-out env")
        loss = self.learner.loss
        optimizer = torch.optim.Adam([*loss.value_network_params.parameters()], lr=3e-4)
        for update in range(1, 4_001):
            value, _ = loss.loss_value(self.batch(64, 64))
            optimizer.zero_grad()
            value.sum().backward()
            optimizer.step()
            self.learner.target_update.step()
            if update in (1_000, 4_000):
                self.rows += [self.judge(held_out, step, update) for step in GATE_STEPS]

    @torch.no_grad()
    def judge(
        self, episodes: list[tuple[list[Tensor], bool]], step: int, update: int
    ) -> dict[str, object]:
        """Return how the critics judge episodes that still run after some steps."""
        running = [(steps, success) for steps, success in episodes if len(steps) > step]
        taken = torch.stack([steps[step] for steps, _ in running])[None, None]
        data = TensorDict({"latent": taken[..., :64], "action": taken[..., 64:]}, taken.shape[:-1])
        value = self.learner.loss.values("target_value_network", data).reshape(-1, len(running))
        lowest, success = value.amin(0).numpy(), np.array([success for _, success in running])
        rank = mannwhitneyu(lowest[success], lowest[~success]).statistic
        left = np.array([len(steps) - step for steps, _ in running])
        row = {
            "task": self.arguments.task,
            "critics": self.arguments.rl.critics,
            "update": update,
            "step": step,
            "episodes": len(running),
            "success": success.mean(),
            "auc": rank / (success.sum() * (~success).sum()),
            "value": lowest.mean(),
            "return": (success * self.arguments.rl.gamma ** (left - 1)).mean(),
        }
        print(*(f"{x:.3g}" if isinstance(x, float) else x for x in row.values()), flush=True)
        return row


def one_task(arguments: Arguments) -> None:
    """Run a trial."""
    torch.set_num_threads(1)
    trial = Trial(arguments)
    if arguments.rl.proposals != "actor":
        trial.imitate()
    if arguments.gate:
        trial.gate()
    else:
        if arguments.rl.proposals != "actor":
            trial.report(0, alone=True)
        trial.play(arguments.episodes, learn=True)
        if arguments.rl.proposals == "both":
            trial.report(arguments.episodes, alone=True)
    if arguments.out is not None:
        pd.DataFrame(trial.rows).to_csv(arguments.out, index=False)


if __name__ == "__main__":
    command_line(one_task)
