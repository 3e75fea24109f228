"""Policies of test episodes, one by one and stacked."""

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.modules.actor_critic import Actor

KEYS = ["state", "context"]
TEMPLATE = Actor(3 + 2, 4, in_keys=KEYS, hidden_sizes=(8,))


def make(seed, batch_size):
    """A policy of a network for each index of `batch_size`, conditioned for 3 x 2 episodes."""
    generator = torch.Generator().manual_seed(seed)
    networks = max(1, torch.Size(batch_size).numel())
    streams = [torch.Generator().manual_seed(10 * seed + i) for i in range(networks)]
    actor = Actor(
        5,
        4,
        in_keys=KEYS,
        hidden_sizes=(8,),
        batch_size=batch_size,
        generator=streams if batch_size else streams[0],
    )
    parameters = {key: value.detach() for key, value in actor.named_parameters()}
    return Policy(TEMPLATE, "state", parameters, torch.randn(3, 2, 2, generator=generator))


@pytest.mark.parametrize("batch_size", [(), (3,), (3, 2)])
def test_a_stack_acts_as_each_of_its_policies_does(batch_size):
    policies = [make(seed, batch_size) for seed in (1, 2)]
    state = torch.randn(2, 3, 2, 3, generator=torch.Generator().manual_seed(0))
    actions = Policy.stack(policies).act(state)
    assert actions.shape == (2, 3, 2, 4)
    for seed, policy in enumerate(policies):
        torch.testing.assert_close(actions[seed], policy.act(state[seed]))
        for task in range(3):
            for episode in range(2):
                where = (task, episode)[: len(batch_size)]
                alone = Actor(5, 4, in_keys=KEYS, hidden_sizes=(8,))
                alone.load_state_dict({k: v[where] for k, v in policy.parameters.items()})
                one = {
                    "state": state[seed, task, episode],
                    "context": policy.context[task, episode],
                }
                action = alone(TensorDict(one))["action"].detach()
                torch.testing.assert_close(actions[seed, task, episode], action)


def test_the_context_makes_a_difference_and_the_template_keeps_its_weights():
    before = [p.clone() for p in TEMPLATE.parameters()]
    policy, state = make(1, ()), torch.zeros(3, 2, 3)
    other = Policy(TEMPLATE, "state", policy.parameters, -policy.context)
    assert not policy.act(state).equal(other.act(state))
    for ours, theirs in zip(TEMPLATE.parameters(), before, strict=True):
        assert ours.equal(theirs)
    assert not policy.act(state).requires_grad
