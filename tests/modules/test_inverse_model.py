"""The inverse model on windows of latents."""

import pytest
import torch

from bgpo_trl.modules.inverse_model import InverseModel, window


@pytest.fixture
def model() -> InverseModel:
    torch.manual_seed(0)
    return InverseModel(3, 2, hidden_size=8)


def test_a_window_holds_the_latents_around_a_step_within_the_episode() -> None:
    """Plain reference: lists; before the first and after the last latent, that one repeats."""
    generator = torch.Generator().manual_seed(0)
    z, length = torch.randn(3, 6, 2, generator=generator), torch.tensor([6, 4, 2])
    for episode, step in [(0, 0), (0, 2), (0, 4), (1, 0), (1, 2), (2, 0)]:
        latents = z[episode, : length[episode]].tolist()
        places = [min(max(step + k, 0), len(latents) - 1) for k in range(-3, 5)]
        expected = [value for place in places for value in latents[place]]
        found = window(z, length, torch.tensor(episode), torch.tensor(step))
        assert found.tolist() == expected


def test_the_actions_of_an_episode_are_those_of_its_windows(model: InverseModel) -> None:
    generator = torch.Generator().manual_seed(0)
    z, length = torch.randn(2, 5, 3, generator=generator), torch.tensor([5, 3])
    action = model(z, length)
    assert action.shape == (2, 4, 2)
    for episode, step in [(0, 0), (0, 3), (1, 1)]:
        alone = model.infer(window(z, length, torch.tensor(episode), torch.tensor(step)))
        torch.testing.assert_close(action[episode, step], alone)
