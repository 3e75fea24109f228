"""The DDPG loss by hand; `test_bgpo_minimal` trains beside a plain DDPG."""

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl import objectives
from torchrl.objectives.value import TD0Estimator, TDLambdaEstimator

from bgpo_trl.configs import RLConfig
from bgpo_trl.modules.actor_critic import Actor, Critic, ProposalPolicy
from bgpo_trl.objectives.ddpg import DDPGLoss, ForeachSoftUpdate
from tests.algorithms.playing import make_batch

STATE, ACTION = 6, 4
N_CRITICS = {"ddpg": 1, "ensemble": 3, "clone": 3}
every_loss = pytest.mark.parametrize("name", N_CRITICS)


def make_loss(name, seed=0, *, stack=(), **options):
    """Make a loss, by default without a stack of seeds."""
    n_critics, source = N_CRITICS[name], torch.Generator().manual_seed(seed)
    network = {"in_keys": ["state"], "hidden_sizes": (16,), "generator": source}

    def actor():
        return Actor(STATE, ACTION, batch_size=stack, **network)

    ensemble = (n_critics,) if n_critics > 1 else ()
    critic = Critic(STATE, ACTION, batch_size=(*stack, *ensemble), **network)
    clone = actor() if name == "clone" else None
    loss = DDPGLoss(actor(), critic, clone, n_critics=n_critics, **options)
    loss.make_value_estimator(gamma=0.98)
    ForeachSoftUpdate(loss, tau=0.005)
    return loss


def gradients(loss, batch):
    loss.zero_grad()
    sum(value for key, value in loss(batch).items() if key.startswith("loss_")).backward()
    return [parameter.grad.clone() for parameter in loss.parameters()]


def targets_of(loss):
    parts = (loss.target_actor_network_params, loss.target_value_network_params)
    return [tensor for part in parts for tensor in part.values(True, True)]


def constant_critics(loss, online, target):
    """Make Q equal to ``online`` and target Q to ``target`` everywhere; triples for ensembles."""
    for parameters, values in (
        (loss.value_network_params, online),
        (loss.target_value_network_params, target),
    ):
        for tensor in parameters.values(True, True):
            tensor.data.zero_()
        bias = parameters["mlp", "layers", "1", "bias"]
        bias.data.copy_(torch.tensor(values).unsqueeze(-1))


# reward, done, terminated -> target with gamma 0.98 and a next value of 0.3
TRANSITIONS = [
    (0.0, False, False, 0.294),
    (0.0, True, False, 0.294),  # truncated: the bootstrap goes on
    (0.0, True, True, 0.0),
    (0.3, True, True, 0.3),
    (1.0, False, False, 1.294),
    (-16.0, False, False, -15.706),  # as Pendulum's may be
]


def constant(name, *values):
    """Values of a critic, or of three equal ones."""
    return values if name == "ddpg" else tuple((value,) * 3 for value in values)


@pytest.mark.parametrize(
    ("name", "target_values"),
    [("ddpg", 0.3), ("ensemble", (0.3, 0.5, 0.9)), ("ensemble", (0.5, 0.3, 0.9))],
)
@pytest.mark.parametrize("bounds", [None, (0.0, 1.1), (-0.2, 0.2)])
def test_targets_and_value_loss_by_hand(name, target_values, bounds):
    """The first pair bootstraps from its smaller value; targets have bounds only where given."""
    loss = make_loss(name, **({} if bounds is None else {"return_bounds": bounds}))
    online = 0.2 if name == "ddpg" else (0.2, 0.6, 0.1)
    constant_critics(loss, online, target_values)
    loss.n_calls += 2  # of three pairs, the first one is next
    reward, done, terminated, target = (torch.tensor(c) for c in zip(*TRANSITIONS, strict=True))
    batch = make_batch(len(TRANSITIONS))
    for key, value in {"reward": reward, "done": done, "terminated": terminated}.items():
        batch["next", key] = value.unsqueeze(-1)
    target = target if bounds is None else target.clamp(*bounds)
    squares = (torch.tensor(online).reshape(-1, 1) - target).square()
    result = loss(batch)
    torch.testing.assert_close(result["target_value"], target)
    torch.testing.assert_close(result["target_value_max"], target.max())
    pre_tanh = loss.actor_network(batch.clone())["pre_tanh_action"].detach()
    torch.testing.assert_close(result["pre_tanh_magnitude"], pre_tanh.square().mean().sqrt())
    torch.testing.assert_close(result["loss_value"], squares.sum(0).mean())
    torch.testing.assert_close(batch["td_error"], squares.amax(0))
    torch.testing.assert_close(result["td_error_max"], squares.max())


def test_all_pairs_of_critics_take_turns():
    loss = make_loss("ensemble", pre_tanh_penalty=0.0)
    constant_critics(loss, (1.0, 10.0, 100.0), (0.1, 0.2, 0.3))
    batch = make_batch(4)
    batch["next", "terminated"].zero_()
    batch["next", "reward"].zero_()
    results = [loss(batch.clone()) for _ in range(6)]
    lower = [result["target_value"][0].item() / 0.98 for result in results]
    mean = [-result["loss_actor"].item() for result in results]
    # The pairs (0, 2), (1, 2), (0, 1), and again.
    assert lower == pytest.approx([0.1, 0.2, 0.1] * 2)
    assert mean == pytest.approx([50.5, 55.0, 5.5] * 2)


def flat_networks(actions, weights):
    """A loss whose actor and clone do two given actions everywhere, and whose Q is linear in them.

    Critic i is the first component of the action times its weight, and so is its target.
    """
    loss = make_loss("clone", pre_tanh_penalty=0.0)
    for name, action in zip(("actor", "clone"), actions, strict=True):
        for tensor in getattr(loss, f"{name}_network_params").values(True, True):
            tensor.data.zero_()
        bias = getattr(loss, f"{name}_network_params")["mlp", "layers", "1", "bias"]
        bias.data[0] = math.atanh(action)
    loss.target_actor_network_params.data.copy_(loss.actor_network_params.data)
    for parameters in (loss.value_network_params, loss.target_value_network_params):
        for tensor in parameters.values(True, True):
            tensor.data.zero_()
        first, last = (parameters["mlp", "layers", str(layer), "weight"] for layer in (0, 1))
        first.data[:, STATE, 0] = 1.0  # a hidden unit that is the action, if positive
        last.data[:, 0, 0] = torch.tensor(weights)
    return loss


@pytest.mark.parametrize(
    ("weights", "best"),
    [
        ((1.0, 2.0, 3.0), 0.6 * 1.0),  # the pair (0, 2) prefers the larger action, the clone's
        ((-1.0, 2.0, -3.0), 0.2 * -3.0),  # the smaller one, the actor's
    ],
)
def test_targets_are_of_the_proposal_that_the_pair_prefers(weights, best):
    loss = flat_networks((0.2, 0.6), weights)
    batch = make_batch(4)
    batch["next", "terminated"].zero_()
    batch["next", "reward"].zero_()
    target = loss(batch)["target_value"]
    torch.testing.assert_close(target, torch.full((4,), 0.98 * best))


@pytest.mark.parametrize(
    ("weights", "caution", "only_clone", "chosen"),
    [
        ((1.0, 2.0, 3.0), 1.0, False, 0.6),
        # The actor's gains are 0.4, 0.8 and 1.2: mean 0.8, standard deviation 0.4.
        ((-1.0, -2.0, -3.0), 1.0, False, 0.2),
        ((-1.0, -2.0, -3.0), 1.9, False, 0.2),
        ((-1.0, -2.0, -3.0), 2.1, False, 0.6),
        ((-1.0, -2.0, -3.0), 1.0, True, 0.6),
        # 0.4, -0.8 and 1.2: mean 0.27, standard deviation 1.01.
        ((-1.0, 2.0, -3.0), 0.0, False, 0.2),
        ((-1.0, 2.0, -3.0), 1.0, False, 0.6),
    ],
)
def test_the_policy_takes_the_actors_proposal_if_critics_agree_that_it_gains(
    weights, caution, only_clone, chosen
):
    loss = flat_networks((0.2, 0.6), weights)
    parts = {"actor": "actor_network", "clone": "clone_network", "critic": "value_network"}
    networks = {}
    for name, attribute in parts.items():
        networks[name] = copy.deepcopy(getattr(loss, attribute))
        getattr(loss, f"{attribute}_params").data.to_module(networks[name])
    policy = ProposalPolicy(**networks, caution=caution)
    policy.only_clone.fill_(only_clone)
    for shape in ((3,), ()):
        action = policy(TensorDict({"state": torch.randn(*shape, STATE)}, shape))["action"]
        torch.testing.assert_close(action[..., 0], torch.full(shape, chosen))


@pytest.mark.parametrize(
    ("name", "part", "weight"), [("clone", "clone", 1), ("ddpg", "actor", 0.7)]
)
def test_imitation_is_the_distance_to_demonstrated_actions_with_its_weight(name, part, weight):
    options = {"imitation": weight} if part == "actor" else {}
    loss, batch = make_loss(name, **options), make_batch(6)
    shown = batch["imitation"]
    action = getattr(loss, f"{part}_network")(shown.select("state"))["action"]
    distance = weight * (action - shown["action"]).square().sum(-1)
    alone = make_loss(name)(batch)["loss_actor"] if part == "actor" else 0
    torch.testing.assert_close(loss(batch)[f"loss_{part}"], alone + distance.mean())
    shown["priority_weight"] = weights = torch.arange(6.0)
    torch.testing.assert_close(loss(batch)[f"loss_{part}"], alone + (distance * weights).mean())
    with pytest.raises(ValueError, match="imitation"):
        loss(batch.exclude("imitation"))


def test_the_imitation_of_each_actor_fades_with_its_own_updates():
    options = {"imitation": 0.7, "imitation_half_life": 2.0, "reduction": "none"}
    loss = make_loss("ddpg", stack=(2,), **options)
    batch = make_batch(2, 6)
    batch["priority_weight"] = torch.tensor([[1.0], [0.0]]).expand(2, 6)
    shown = batch["imitation"]
    shown["priority_weight"] = torch.ones(2, 6)
    action = loss.actor_network(shown.select("state"))["action"]
    distance = (action - shown["action"]).square().sum(-1).mean(-1)
    before = loss(batch)["loss_actor"]
    for _ in range(3):
        loss(batch)
    # The first actor has had four updates, the other one, without transitions, none.
    faded = torch.tensor([0.7 - 0.7 / 4, 0.0]) * distance
    torch.testing.assert_close(before - loss(batch)["loss_actor"], faded)


@every_loss
def test_entries_may_have_other_names(name):
    batch = make_batch(4)
    expected = make_loss(name)(batch.clone())
    other = batch.exclude(("next", "reward"), ("next", "terminated"))
    other["next", "pay"] = batch["next", "reward"]
    other["next", "won"] = batch["next", "terminated"]
    loss = make_loss(name)
    loss.set_keys(reward="pay", terminated="won", priority="error")
    result = loss(other)
    assert set(result.keys()) == set(loss.out_keys)
    for key, value in result.items():
        assert value.equal(expected[key]), key
    assert other["error"].amax().equal(expected["td_error_max"])
    loss.make_value_estimator(gamma=0.5)  # keeps the names
    assert not loss(other)["target_value"].equal(expected["target_value"])
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(prize="pay")


@every_loss
def test_the_discount_is_that_of_the_value_estimator(name):
    by_default = DDPGLoss(Actor(STATE), Critic(STATE)).value_estimator.gamma.item()
    assert by_default == pytest.approx(RLConfig.gamma)
    batch = make_batch(4)
    batch["next", "terminated"].zero_()
    batch["next", "reward"].zero_()
    loss = make_loss(name)
    constant_critics(loss, *constant(name, 0.0, 0.5))
    for estimator in (None, objectives.ValueEstimators.TD0, TD0Estimator):
        loss.make_value_estimator(estimator, gamma=0.5)
        torch.testing.assert_close(loss(batch)["target_value"], torch.full((4,), 0.25))
    for gamma in (1.5, math.nan):
        with pytest.raises(ValueError, match="gamma"):
            loss.make_value_estimator(gamma=gamma)
    with pytest.raises(NotImplementedError):
        loss.make_value_estimator(objectives.ValueEstimators.GAE)


@every_loss
def test_targets_of_several_steps_are_discounted_as_often(name):
    loss = make_loss(name)
    constant_critics(loss, *constant(name, 0.0, 0.5))
    batch = make_batch(8)
    batch["next", "terminated"].zero_()
    steps = torch.arange(1, 9).unsqueeze(-1)
    target = loss(batch.set("steps_to_next_obs", steps))["target_value"]
    expected = batch["next", "reward"] + 0.5 * 0.98**steps
    torch.testing.assert_close(target, expected.squeeze(-1))


@every_loss
@pytest.mark.parametrize("change", [copy.deepcopy, lambda loss: loss.double().float()])
def test_a_copied_or_cast_loss_still_follows_its_parameters(name, change):
    loss, batch = make_loss(name), make_batch(16)
    loss(batch.clone())  # networks that were made for it must not outlive the change
    loss, fresh = change(loss), make_loss(name, seed=1)
    loss.load_state_dict(fresh.state_dict())
    mine, theirs = loss(batch.clone()), fresh(batch.clone())
    for key, value in theirs.items():
        torch.testing.assert_close(mine[key], value)
    for grad, other in zip(gradients(loss, batch), gradients(fresh, batch), strict=True):
        torch.testing.assert_close(grad, other)


@every_loss
@pytest.mark.parametrize("pickled", [False, True])
def test_targets_follow_by_a_share_also_after_a_cast(name, pickled):
    loss = make_loss(name)
    update = ForeachSoftUpdate(loss, tau=0.1)
    loss.double()
    if pickled:
        loss, update = pickle.loads(pickle.dumps((loss, update)))
    before = [target.clone() for target in targets_of(loss)]
    for parameter in loss.parameters():
        parameter.data.add_(1.0)
    for _ in range(3):
        update.step()
    for target, old in zip(targets_of(loss), before, strict=True):
        torch.testing.assert_close(target, old + 1 - 0.9**3)


def test_weights_are_factors_of_each_transitions_losses():
    loss, batch = make_loss("ddpg", pre_tanh_penalty=0.5), make_batch(8)
    weights = torch.linspace(0, 2, 8)
    plain = loss(batch.clone())
    error = (plain["pred_value"] - plain["target_value"]).square()
    data = loss.actor_network(batch.select("state"))
    value = loss.value_network(data)["state_action_value"].squeeze(-1)
    penalty = 0.5 * data["pre_tanh_action"].square().mean(-1)
    batch["priority_weight"] = weights
    result = loss(batch)
    torch.testing.assert_close(result["loss_value"], (weights * error).mean())
    torch.testing.assert_close(result["loss_actor"], (weights * (penalty - value)).mean())
    loss.use_prioritized_weights = False
    torch.testing.assert_close(loss(batch)["loss_value"], error.mean())


def test_an_actor_without_pre_tanh_actions_needs_no_penalty_and_reports_no_magnitude():
    actor = TensorDictModule(torch.nn.Linear(STATE, ACTION), ["state"], ["action"])
    critic, batch = Critic(STATE, ACTION, in_keys=["state"]), make_batch(4)
    loss = DDPGLoss(actor, critic)
    with pytest.raises(ValueError, match="pre_tanh_penalty=0"):
        loss(batch.clone())
    loss.set_keys(pre_tanh_action="action")
    action = actor(batch.select("state"))["action"]
    magnitude = loss(batch.clone())["pre_tanh_magnitude"]
    torch.testing.assert_close(magnitude, action.square().mean().sqrt().detach())
    free = DDPGLoss(actor, critic, pre_tanh_penalty=0)
    assert set(free.out_keys) == set(free(batch).keys())


class Normed(torch.nn.Module):
    """A critic that sees a whole batch at once, through batch norm."""

    def __init__(self):
        super().__init__()
        self.norm, self.out = torch.nn.BatchNorm1d(STATE + ACTION), torch.nn.Linear(10, 1)

    def forward(self, state, action):
        return self.out(self.norm(torch.cat([state, action], 1)))


def test_a_single_critic_may_be_any_module():
    actor, normed = Actor(STATE, ACTION, in_keys=["state"]), Normed()
    critic = TensorDictModule(normed, ["state", "action"], ["state_action_value"])
    loss, batch = DDPGLoss(actor, critic, actor_clone := copy.deepcopy(actor)), make_batch(10)
    batch["imitation"] = batch.select("state", "action")
    after = batch["next", "state"]
    best = torch.stack(
        [
            copy.deepcopy(normed)(after, one(TensorDict(state=after, batch_size=[10]))["action"])
            for one in (actor, actor_clone)
        ]
    ).amax(0)
    followed = batch["next", "reward"] + RLConfig.gamma * ~batch["next", "terminated"] * best
    torch.testing.assert_close(loss(batch)["target_value"], followed.detach().squeeze(-1))


def test_parameters_are_drawn_anew_and_estimators_of_trajectories_refused():
    loss = make_loss("ddpg")
    before = [parameter.clone() for parameter in loss.parameters()]
    loss.reset_parameters_recursive()
    assert not any(map(torch.equal, before, loss.parameters()))
    with pytest.raises(NotImplementedError, match="TDLambdaEstimator needs whole trajectories"):
        loss.make_value_estimator(TDLambdaEstimator, gamma=0.9, lmbda=0.9)
