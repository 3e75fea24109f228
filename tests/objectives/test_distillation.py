"""The distillation loss and its gradients against the closed form."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from bgpo_trl.modules.multi_head_actor import MultiHeadActor
from bgpo_trl.objectives.distillation import DistillationLoss

# Two tasks, three states of each, two action components.
MEAN = [[[0.0, 0.5], [-0.25, 1.0], [0.1, 0.2]], [[0.0, 0.0], [0.75, -0.5], [-1.0, 0.3]]]
SCALE = [[[0.1, 0.2], [1.0, 0.5], [0.3, 0.3]], [[0.25, 1.0], [0.4, 0.1], [0.15, 0.9]]]
ACTION = [[[0.2, 0.5], [0.25, 0.0], [-0.4, 0.8]], [[0.0, 1.0], [0.7, -0.4], [-1.0, -0.6]]]


class Given(TensorDictModuleBase):
    """A policy whose states are the parameters of its distributions."""

    def __init__(self, names=("loc", "scale")):
        super().__init__()
        self.names = names
        self.in_keys, self.out_keys = ["parameters"], list(names)

    def forward(self, tensordict):
        for name, value in zip(self.names, tensordict["parameters"].unbind(-1), strict=True):
            tensordict.set(name, value)
        return tensordict


def given_batch(teacher_action="teacher_action"):
    parameters = torch.stack([torch.tensor(MEAN), torch.tensor(SCALE)], -1)
    batch = {
        "parameters": parameters.requires_grad_(),
        teacher_action: torch.tensor(ACTION).requires_grad_(),
    }
    return TensorDict(batch, [2, 3])


def expected_loss():
    total = 0.0
    for of_task in zip(MEAN, SCALE, ACTION, strict=True):
        for m, s, a in zip(*of_task, strict=True):
            for mean, scale, action in zip(m, s, a, strict=True):
                nll = 0.5 * math.log(2 * math.pi * scale**2)
                nll += (action - mean) ** 2 / (2 * scale**2)
                total += nll / 3  # a mean over the states, a sum over the rest
    return total


def test_the_loss_is_the_negative_log_likelihood_of_the_teachers_actions():
    batch = given_batch()
    losses = DistillationLoss(Given())(batch)
    assert losses["loss_distillation"].shape == ()
    assert losses["loss_distillation"].item() == pytest.approx(expected_loss(), rel=1e-5)
    assert set(batch.keys()) == {"parameters", "teacher_action"}


def test_gradients_are_those_of_the_student_and_the_teacher_has_none():
    batch = given_batch()
    DistillationLoss(Given())(batch)["loss_distillation"].backward()
    mean, scale, action = (torch.tensor(values) for values in (MEAN, SCALE, ACTION))
    error = mean - action
    expected = torch.stack([error / scale**2, 1 / scale - error**2 / scale**3], -1) / 3
    torch.testing.assert_close(batch["parameters"].grad, expected)
    assert batch["teacher_action"].grad is None


def test_entries_can_have_other_names():
    loss = DistillationLoss(Given(("mu", "sigma")))
    loss.set_keys(loc="mu", scale="sigma", teacher_action="shown")
    assert loss.in_keys == ["parameters", "shown"]
    value = loss(given_batch("shown"))["loss_distillation"]
    assert value.item() == pytest.approx(expected_loss(), rel=1e-5)


def student(n_heads=2):
    actor = MultiHeadActor(3, 2, in_keys=["state"], generator=torch.Generator().manual_seed(0))
    for head in range(n_heads):
        actor.add_head(torch.Generator().manual_seed(head))
    return actor


def test_keys_and_parameters_are_those_of_the_student():
    actor = student()
    loss = DistillationLoss(actor)
    assert loss.in_keys == ["state", "teacher_action"]
    assert loss.out_keys == ["loss_distillation"]
    assert [id(p) for p in loss.parameters()] == [id(p) for p in actor.parameters()]
    actor.add_head()  # later heads are learned, too
    assert len(list(loss.parameters())) == 10


def test_weights_are_factors_of_the_losses_of_states():
    batch = given_batch()
    whole = DistillationLoss(Given())(batch)["loss_distillation"]
    weights = torch.tensor([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    first = DistillationLoss(Given())(batch.set("priority_weight", weights))["loss_distillation"]
    second = DistillationLoss(Given())(batch.set("priority_weight", 1 - weights))
    torch.testing.assert_close(first + second["loss_distillation"], whole)
    first.backward()
    assert (batch["parameters"].grad[0] != 0).any() and (batch["parameters"].grad[1] == 0).all()


@pytest.mark.parametrize("entry", ["teacher_action", "priority_weight"])
def test_entries_that_would_broadcast_are_refused(entry):
    batch = given_batch()
    batch[entry] = torch.ones(2, 3, 1)
    with pytest.raises(ValueError, match=entry):
        DistillationLoss(Given())(batch)
