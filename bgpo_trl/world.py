"""Simulations of a batch of seeds, with their draws of tasks and demonstrations."""

from __future__ import annotations

from typing import Any

import torch
from torchrl.envs import EnvBase

from bgpo_trl.algorithms import Algorithm
from bgpo_trl.seeding import generators, stream_seed
from bgpo_trl.transforms import DemonstrationSource, TaskSchedule


class World:
    """Simulations of an algorithm's seeds, within its transforms.

    Episodes show the demonstrations of its bank.

    Args:
        algorithm: The algorithm, which makes the environment.
        schedule: Times at which tasks are presented.
        spread: Share of the whole range of start states.

    Raises:
        ValueError: If the algorithm's scene has no such task, spread or ground truth.
        TypeError: If the algorithm makes something else than an environment of all seeds.

    Attributes:
        env: The simulation within the algorithm's transforms.
        source: The transform that draws task and demonstration of each episode.
        simulation: The environment without transforms.
    """

    def __init__(
        self, algorithm: Algorithm, *, schedule: TaskSchedule, spread: float = 1.0
    ) -> None:
        bank, seeds = algorithm.bank, algorithm.seeds
        batch = torch.Size([len(seeds)])
        self.source = DemonstrationSource(
            bank, schedule, batch_size=batch, generator=generators(seeds, "demonstrations")
        )
        self._scene = algorithm.scene
        self.simulation = self._scene.simulate(
            bank.tasks,
            batch_size=batch,
            seed=[stream_seed(seed, "env") for seed in seeds],
            spread=spread,
            observation="pixels" if algorithm.config.state == "latent" else "state",
        )
        self.env = algorithm.make_env(self.simulation, self.source)
        if not isinstance(self.env, EnvBase) or self.env.batch_size != batch:
            raise TypeError(
                f"make_env of {type(algorithm).__name__} must return the simulations {list(batch)} "
                f"within transforms, got {type(self.env).__name__}"
            )

    def state_dict(self) -> dict[str, Any]:
        """Return the state of draws and simulations, without the tensordict between two steps.

        That of simulations is None if they cannot be saved.
        """
        # An environment of one's own need not have it.
        save = getattr(self.simulation, "simulation_state", None)
        try:
            simulation = None if save is None else save()
        except NotImplementedError:
            simulation = None
        return {"source": dict(self.source.state_dict()), "simulation": simulation}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a `state_dict` that `check_state` accepts."""
        self.env.reset()  # Transforms create their caches at the first reset.
        self.source.load_state_dict(state["source"])
        self.simulation.load_simulation_state(state["simulation"])

    def check_state(self, state: dict[str, Any]) -> None:
        """Raise ``ValueError`` unless a `state_dict` holds the state of the simulations."""
        if "simulation" in state and state["simulation"] is None:
            raise ValueError(
                f"simulations of the scene {self._scene.name!r} cannot be saved, so this run "
                "cannot be resumed: begin another one, or define save and load of its Simulation"
            )
