"""The noise of imitated states, where clones need fine latents and where they learn by heart."""

from dataclasses import replace

import pytest
import torch

from bgpo_trl.data.bank import DemonstrationBank, DemonstrationSteps
from bgpo_trl.encoders.imitation import choose_noise
from bgpo_trl.encoders.pretrained import load_pretrained
from suites import nico

N_LATENTS, N_STEPS = 32, 20


def bank_of(latent, action):
    """A bank of one task, all for training."""
    n = len(latent)
    steps = DemonstrationSteps.of(latent, action, torch.full([n], N_STEPS + 1))
    task, train = torch.zeros(n, dtype=torch.int64), torch.ones(n, dtype=torch.bool)
    return DemonstrationBank(torch.zeros(n, 32), task, train, ("reach",), steps)


def latents(n):
    return torch.randn(n, N_STEPS + 1, N_LATENTS, generator=torch.Generator().manual_seed(0))


def fine():
    """Actions turn within a tenth of a latent's deviation."""
    latent = latents(120)
    return bank_of(latent, (20 * latent[:, :-1, :2]).clamp(-1, 1))


def by_heart():
    """Actions follow latents slowly, and tremble; there are few."""
    latent = latents(16)
    tremor = 0.5 * torch.randn(16, N_STEPS, 2, generator=torch.Generator().manual_seed(1))
    return bank_of(latent, (0.1 * latent[:, :-1, :2] + tremor).clamp(-1, 1))


def constant():
    """Actions are always the same, and so large that a clone meets them exactly."""
    return bank_of(latents(16), torch.ones(16, N_STEPS, 2))


@pytest.mark.parametrize(
    ("made", "least", "most"), [(fine, 0.0, 0.05), (by_heart, 0.2, 0.2), (constant, 0.2, 0.2)]
)
def test_noise_suits_what_demonstrations_need(made, least, most):
    bank = made()
    noise = choose_noise(bank)
    assert least <= noise <= most
    twin = replace(bank, tasks=("reach", "push"), task=torch.arange(len(bank.task)) % 2)
    assert least <= choose_noise(twin) <= most


@pytest.mark.slow
@pytest.mark.parametrize("tasks", [nico.PAPER_TASKS, nico.ALL_TASKS])
def test_shipped_banks_have_the_noise_that_would_be_chosen(tasks):
    bank = load_pretrained(tasks=tasks)[1]
    assert choose_noise(bank) == bank.noise


def test_of_too_few_demonstrations_nothing_is_told():
    bank = by_heart()
    assert choose_noise(replace(bank, steps=None)) is None
    few = torch.arange(16) < 7
    assert choose_noise(replace(bank, train=few)) is None
    assert choose_noise(replace(bank, tasks=("reach", "push"))) is None
