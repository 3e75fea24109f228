"""Policies of test episodes, one by one and stacked."""

import itertools

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.modules.actor_critic import Actor

KEYS = ["state", "context"]
TEMPLATE = Actor(3 + 2, 4, in_keys=KEYS, hidden_sizes=(8,))


NETWORK = torch.tensor([[0, 1], [1, 1], [2, 0]])


def make(seed, batch_size):
    """A policy of one network or of three, conditioned for 3 x 2 episodes."""
    generator = torch.Generator().manual_seed(seed)
    actor = Actor(5, 4, in_keys=KEYS, hidden_sizes=(8,), batch_size=batch_size, generator=generator)
    parameters = {key: value.detach() for key, value in actor.named_parameters()}
    context = torch.randn(3, 2, 2, generator=generator)
    return Policy(TEMPLATE, "state", parameters, context, NETWORK if batch_size else None)


@pytest.mark.parametrize("batch_size", [(), (3,)])
def test_a_stack_acts_as_each_of_its_policies_does(batch_size):
    policies = [make(seed, batch_size) for seed in (1, 2)]
    state = torch.randn(2, 3, 2, 3, generator=torch.Generator().manual_seed(0))
    actions = Policy.stack(policies).act(state)
    assert not actions.requires_grad
    for seed, task, episode in itertools.product(range(2), range(3), range(2)):
        policy, where = policies[seed], NETWORK[task, episode] if batch_size else ()
        alone = Actor(5, 4, in_keys=KEYS, hidden_sizes=(8,))
        alone.load_state_dict({k: v[where] for k, v in policy.parameters.items()})
        one = {"state": state[seed, task, episode], "context": policy.context[task, episode]}
        action = alone(TensorDict(one))["action"].detach()
        torch.testing.assert_close(actions[seed, task, episode], action)
        torch.testing.assert_close(policy.act(state[seed])[task, episode], action)


def test_the_template_keeps_its_weights():
    before = [p.clone() for p in TEMPLATE.parameters()]
    make(1, ()).act(torch.zeros(3, 2, 3))
    for ours, theirs in zip(TEMPLATE.parameters(), before, strict=True):
        assert ours.equal(theirs)
