"""How much noise the demonstrated states that a policy imitates should get: `choose_noise`."""

from __future__ import annotations

import torch
from torch import Tensor

from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.modules.stacked_mlp import StackedMLP

_NOISES = (0.0, 0.02, 0.05, 0.1, 0.2)
_FEWEST, _MOST = 8, 125  # demonstrations of a task, of which a fifth judges
_N_UPDATES, _N_ROWS = 500, 128
_AS_GOOD = 1.01
_NO_ERROR = 1e-4  # squared; of actions in [-1, 1]


def choose_noise(bank: DemonstrationBank) -> float | None:
    """Return the noise with which clones err least on demonstrations that they have not seen.

    Noise keeps a clone from learning a few demonstrations by heart, and blurs what it sees: how
    much is good depends on how finely latents tell places apart. For each task and noise, a clone
    learns from four fifths of up to 125 training demonstrations. Of noises that are within 1 % of
    the best, in the mean over tasks of the squared error of actions, the largest is chosen.

    Args:
        bank: Demonstrations, with steps.

    Returns:
        Standard deviation, in those of a latent; None if a task has fewer than eight demonstrations
        or the bank has no steps.
    """
    seen = bank.seen()
    count = seen.task.bincount(minlength=len(bank.tasks))
    if seen.steps is None or len(count) == 0 or int(count.min()) < _FEWEST:
        return None
    error = torch.stack([_errors(seen.of_task(task)) for task in range(len(bank.tasks))])
    # Of actions that are always the same, no clone errs.
    error = error.clamp_min(_NO_ERROR)
    relative = (error / error.amin(1, keepdim=True)).mean(0)
    good = relative <= _AS_GOOD * relative.min()
    return max(noise for noise, kept in zip(_NOISES, good.tolist(), strict=True) if kept)


@torch.enable_grad()
def _errors(bank: DemonstrationBank) -> Tensor:
    """Return the squared error of a clone for each noise ``[K]``, on a fifth of a task."""
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(len(bank.task), generator=generator)[:_MOST]
    n_judges = len(order) // 5
    (state, action), (unseen, true) = _steps(bank, order[n_judges:]), _steps(bank, order[:n_judges])
    alike = [torch.Generator().manual_seed(1) for _ in _NOISES]
    sizes = (state.shape[-1], action.shape[-1])
    clones = StackedMLP(*sizes, hidden_sizes=(256, 256), batch_size=len(_NOISES), generator=alike)
    noise = torch.tensor(_NOISES)[:, None, None]
    optimizer = torch.optim.Adam(clones.parameters(), lr=1e-3)
    for _ in range(_N_UPDATES):
        row = torch.randint(len(state), (_N_ROWS,), generator=generator)
        blur = torch.randn(_N_ROWS, state.shape[-1], generator=generator)
        loss = (clones(state[row] + noise * blur).tanh() - action[row]).square().sum()
        optimizer.zero_grad()
        (loss / _N_ROWS).backward()
        optimizer.step()
    with torch.no_grad():
        cloned = clones(unseen.expand(len(_NOISES), *unseen.shape)).tanh()
    return (cloned - true).square().mean((1, 2))


def _steps(bank: DemonstrationBank, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return latents ``[M, 64]`` and actions ``[M, A]`` of some demonstrations."""
    steps = bank.steps
    assert steps is not None
    frame = torch.cat(
        [steps.first[row] + torch.arange(int(steps.length[row]) - 1) for row in rows.tolist()]
    )
    return steps.latents(frame), steps.actions(frame)
