"""TorchRL's conventions, which hold for all off-policy losses alike."""

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl import objectives
from torchrl.objectives.value import TD0Estimator

from bgpo_trl.configs import RLConfig
from bgpo_trl.modules.actor_critic import Actor, Critic
from bgpo_trl.modules.gaussian_actor import GaussianActor
from bgpo_trl.objectives.ddpg import DDPGLoss
from bgpo_trl.objectives.sac import SACLoss
from bgpo_trl.objectives.target_update import ForeachSoftUpdate
from bgpo_trl.objectives.td3 import TD3Loss

LOSSES = {DDPGLoss: Actor, TD3Loss: Actor, SACLoss: GaussianActor}
every_loss = pytest.mark.parametrize("kind", LOSSES)


def make(kind, seed=0, stack=(2, 3), **options):
    generator = torch.Generator().manual_seed(seed)
    network = {"in_keys": ["state", "label"], "hidden_sizes": (8,), "generator": generator}
    critics = (*stack, 2) if kind.twin_critics else stack
    if kind.twin_critics:
        options["generator"] = torch.Generator().manual_seed(seed)
    actor = LOSSES[kind](5, 2, batch_size=stack, **network)
    loss = kind(actor, Critic(5, 2, batch_size=critics, **network), **options)
    ForeachSoftUpdate(loss, tau=0.1)
    return loss


def make_batch(*shape, dtype=torch.float32):
    generator = torch.Generator().manual_seed(5)

    def draw(size):
        return torch.randn(*shape, size, generator=generator).to(dtype)

    flag = draw(1) > 0.5
    successor = {"state": draw(3), "label": draw(2), "reward": draw(1), "terminated": flag}
    batch = {"state": draw(3), "label": draw(2), "action": draw(2).clamp(-1, 1)}
    return TensorDict({**batch, "next": successor}, shape)


@every_loss
def test_it_can_be_called_with_keywords(kind):
    batch = make_batch(2, 3, 4).set("priority_weight", torch.rand(2, 3, 4))
    expected, loss = make(kind)(batch.clone()), make(kind)
    entries = {
        key if isinstance(key, str) else "_".join(key): batch.get(key, None) for key in loss.in_keys
    }
    told = loss(**{key: value for key, value in entries.items() if value is not None})
    assert set(loss.out_keys) == set(expected.keys())
    for key, value in zip(loss.out_keys, told, strict=True):
        assert value.equal(expected[key]), key


@every_loss
def test_entries_may_have_other_names(kind):
    batch = make_batch(2, 3, 4)
    expected = make(kind)(batch.clone())
    other = batch.exclude(("next", "reward"), ("next", "terminated"))
    other["next", "pay"], other["next", "won"] = (
        batch["next", "reward"],
        batch["next", "terminated"],
    )
    loss = make(kind)
    loss.set_keys(reward="pay", terminated="won", priority="error")
    for key, value in loss(other).items():
        assert value.equal(expected[key]), key
    assert other["error"].amax(-1).equal(expected["td_error_max"])
    loss.make_value_estimator(gamma=0.5)
    assert not loss(other)["target_value"].equal(expected["target_value"])
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(prize="pay")


@every_loss
def test_the_discount_is_that_of_the_configs_unless_told(kind):
    loss = make(kind)
    torch.testing.assert_close(loss.value_estimator.gamma.item(), RLConfig.gamma, rtol=1e-6, atol=0)
    for estimator in (None, objectives.ValueEstimators.TD0, TD0Estimator):
        loss.make_value_estimator(estimator, gamma=0.5)
        assert loss.value_estimator.gamma == 0.5
    with pytest.raises(NotImplementedError, match="choose TD0"):
        loss.make_value_estimator(objectives.ValueEstimators.GAE)


@every_loss
@pytest.mark.parametrize("change", [copy.deepcopy, lambda loss: loss.double().float()])
def test_a_copied_or_cast_loss_still_follows_its_parameters(kind, change):
    loss, batch = make(kind), make_batch(2, 3, 4)
    loss(batch.clone())  # networks that were made for it must not outlive the change
    loss, fresh = change(loss), make(kind, seed=1)
    fresh.make_value_estimator()
    loss.load_state_dict(fresh.state_dict())
    mine, theirs = loss(batch.clone()), fresh(batch.clone())
    for key, value in theirs.items():
        torch.testing.assert_close(mine[key], value)
    for result in (mine, theirs):
        sum(value for key, value in result.items() if key.startswith("loss_")).backward()
    for ours, other in zip(loss.parameters(), fresh.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, other.grad)


@every_loss
def test_it_computes_in_double_precision(kind):
    loss = make(kind).double()
    result = loss(make_batch(2, 3, 4, dtype=torch.float64))
    assert {value.dtype for value in result.values()} == {torch.float64}
    single = make(kind)(make_batch(2, 3, 4))
    for key, value in result.items():
        torch.testing.assert_close(value.float(), single[key], rtol=1e-4, atol=1e-4)


@every_loss
def test_its_targets_move_as_with_torchrls_soft_update(kind):
    losses = make(kind), make(kind)
    updates = ForeachSoftUpdate(losses[0], tau=0.1), objectives.SoftUpdate(losses[1], tau=0.1)
    for loss, update in zip(losses, updates, strict=True):
        for parameter in loss.parameters():
            parameter.data.add_(1.0)
        update.step()
    expected = losses[1].state_dict()
    for key, value in losses[0].state_dict().items():
        torch.testing.assert_close(value, expected[key])


@every_loss
def test_it_computes_with_the_parameters_put_into_it(kind):
    batch, loss, other = make_batch(2, 3, 4), make(kind), make(kind, seed=1)
    own = TensorDict.from_module(loss)
    # Before the first call and after it: networks are made once and kept.
    for _ in range(2):
        with own.apply(torch.zeros_like).to_module(loss):
            assert not loss(batch.clone())["pred_value"].any()
        assert loss(batch.clone())["pred_value"].abs().amax() > 0
    loss.value_network_params = other.value_network_params
    predicted = loss(batch.clone())["pred_value"]
    assert predicted.equal(other(batch.clone())["pred_value"])


@every_loss
def test_a_network_in_a_container_is_refused(kind):
    # It hides the batch size, and with it the seeds whose losses are summed.
    network = {"in_keys": ["state"], "batch_size": (3,)}
    actor = LOSSES[kind](3, 2, **network)
    critics = Critic(3, 2, in_keys=["state"], batch_size=(3, 2) if kind.twin_critics else (3,))
    kind(actor, critics)
    with pytest.raises(ValueError, match=r"value_network must hold .* each actor, batch_size"):
        kind(TensorDictSequential(actor), critics)


@every_loss
def test_a_constant_entry_that_no_network_reads_is_refused(kind):
    assert make(kind, constant_keys=[("label",)]).inputs.moving_keys == ["state"]
    with pytest.raises(
        ValueError, match=r"constant_keys must be among .*'label'.* got \['lable'\]"
    ):
        make(kind, constant_keys=["lable"])


def test_an_actor_without_pre_tanh_actions_promises_no_magnitude():
    actor = TensorDictModule(torch.nn.Linear(3, 2), ["state"], ["action"])
    loss = DDPGLoss(actor, Critic(3, 2, in_keys=["state"]), pre_tanh_penalty=0.0)
    batch = make_batch(4)
    told = loss(batch)
    assert set(loss.out_keys) == set(told.keys())
    read = ["state", "reward", "terminated"]
    successor = {f"next_{key}": batch["next", key] for key in read}
    values = loss(state=batch["state"], action=batch["action"], **successor)
    assert len(values) == len(loss.out_keys)


@every_loss
def test_it_runs_under_autocast(kind):
    loss, batch = make(kind), make_batch(2, 3, 8)
    exact = loss(batch.clone())["pred_value"]
    with torch.autocast("cpu", torch.bfloat16):
        rounded = loss(batch.clone())["pred_value"]
    torch.testing.assert_close(rounded.float(), exact, atol=0.02, rtol=0.02)


def test_a_frozen_network_has_no_parameters_to_differentiate():
    networks = {"in_keys": ["state"], "batch_size": (2,)}
    loss = DDPGLoss(Actor(3, **networks), Critic(3, **networks))
    for frozen in (False, True):
        with loss.network("value_network", frozen=frozen) as critic:
            assert [p.requires_grad for p in critic.parameters()] == 4 * [not frozen]
