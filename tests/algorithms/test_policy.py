"""Policies of test episodes."""

import itertools

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.modules.actor_critic import Actor

KEYS = ["state", "context"]
TEMPLATE = Actor(3 + 2, 4, in_keys=KEYS, hidden_sizes=(8,))


@pytest.mark.parametrize("number", [1, 3])
def test_each_test_episode_is_played_by_its_network(number):
    """With its own context; the template keeps its weights."""
    generator = torch.Generator().manual_seed(0)
    actor = Actor(5, 4, in_keys=KEYS, hidden_sizes=(8,), batch_size=(number,), generator=generator)
    parameters = {key: value.detach() for key, value in actor.named_parameters()}
    network = torch.arange(6).view(3, 2) % number
    context, state = torch.randn(3, 2, 5, generator=generator).split([2, 3], -1)
    before = [p.clone() for p in TEMPLATE.parameters()]
    actions = Policy(TEMPLATE, "state", parameters, context, network).act(state)
    assert not actions.requires_grad
    for where in itertools.product(range(3), range(2)):
        alone = Actor(5, 4, in_keys=KEYS, hidden_sizes=(8,))
        alone.load_state_dict({k: v[network[where]] for k, v in parameters.items()})
        one = TensorDict({"state": state[where], "context": context[where]})
        torch.testing.assert_close(actions[where], alone(one)["action"].detach())
    for ours, theirs in zip(TEMPLATE.parameters(), before, strict=True):
        assert ours.equal(theirs)
