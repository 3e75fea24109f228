"""Gaussian noise of losses, drawn from one generator per seed."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from bgpo_trl.seeding import normal

__all__ = ["SeededNoise"]


class SeededNoise(nn.Module):
    """Standard normal noise for a stack of seeds, each from its own generator.

    TorchRL's losses draw from PyTorch's global generator, so that a seed of a stack would differ
    from that seed alone, and a resumed run from an uninterrupted one. The ``state_dict`` of this
    module, and of a loss that contains it, has the states of the generators.

    Args:
        batch_size: Leading dimensions ``S`` of the stack.
        generator: One generator for each index of ``S``, or a single one for all; ``None`` draws
            from torch's default generator, whose state is not saved.

    Raises:
        ValueError: If the number of generators is not that of the seeds.

    Examples:
        >>> noise = SeededNoise([2], [torch.Generator().manual_seed(seed) for seed in (3, 8)])
        >>> noise(torch.zeros(2, 128, 4)).shape
        torch.Size([2, 128, 4])
    """

    def __init__(
        self,
        batch_size: Sequence[int] = (),
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        self.batch_size = torch.Size(batch_size)
        self.generators: list[torch.Generator] = []
        if isinstance(generator, torch.Generator):
            self.generators = [generator]
        elif generator is not None:
            self.generators = list(generator)
            if len(self.generators) != self.batch_size.numel():
                raise ValueError(
                    f"pass one generator a seed: {self.batch_size.numel()} are needed, got "
                    f"{len(self.generators)}"
                )

    def forward(self, like: Tensor) -> Tensor:
        """Return noise of the shape, dtype and device of ``like`` ``[*S, ...]``."""
        if len(self.generators) < 2:
            drawn = torch.randn(like.shape, generator=next(iter(self.generators), None))
        else:
            drawn = normal(self.generators, like.shape[len(self.batch_size) :]).view(like.shape)
        return drawn.to(like)

    def get(self, seed: int, expert: int) -> Tensor:
        """Return the state of a generator, in a batch ``[S, E]``."""
        return self.generators[seed * self.batch_size[1] + expert].get_state()

    def set(self, seed: int, expert: int, state: Tensor) -> None:
        """Restore the result of `get`."""
        self.generators[seed * self.batch_size[1] + expert].set_state(state.cpu())

    def resize(self, width: int) -> None:
        """Change ``E`` of a batch ``[S, E]``; generators that are added have yet to be `set`."""
        n_seeds, now = self.batch_size
        self.generators = [
            self.generators[seed * now + expert] if expert < now else torch.Generator()
            for seed in range(n_seeds)
            for expert in range(width)
        ]
        self.batch_size = torch.Size([n_seeds, width])

    def get_extra_state(self) -> Tensor:
        """Return the states of the generators, uint8 ``[number, bytes]``."""
        states = [generator.get_state() for generator in self.generators]
        return torch.stack(states) if states else torch.empty(0, dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the result of `get_extra_state`."""
        if len(state) != len(self.generators):
            raise ValueError(
                f"the state was saved with {len(state)} generators, this loss has "
                f"{len(self.generators)}: pass as many"
            )
        for generator, saved in zip(self.generators, state, strict=True):
            generator.set_state(saved.clone())  # set_state crashes on a view
