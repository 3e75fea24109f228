"""RL algorithms in BGPO: how they explore and update, and the place for one's own."""

from dataclasses import dataclass, replace

import pytest
import torch
from tensordict import TensorDict

from bgpo_trl.algorithms import ALGORITHMS
from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.bgpo import BGPO
from bgpo_trl.algorithms.rl import RL, LearnerSpec, RLEntry, make_ddpg, make_learner
from bgpo_trl.configs import DDPGConfig, RLConfig, TD3Config
from bgpo_trl.seeding import generators
from tests.algorithms.playing import make_batch

pytestmark = pytest.mark.usefixtures("easy_world")
every_rl = pytest.mark.parametrize("name", RL)
SEEDS = (3, 8)


def make(name, seeds=SEEDS, experts=(0,), **changes):
    config = replace(RL[name].config, **{"hidden_sizes": (16,), **changes})
    spec = LearnerSpec(seeds, ["state", "label"], 6 + 2, (0.0, 1.3), torch.device("cpu"), experts)
    return make_learner(config, spec)


def weights(learner):
    return {key: value.clone() for key, value in learner.loss.named_parameters()}


def targets(learner):
    return {key: v.clone() for key, v in learner.loss.state_dict().items() if "target_" in key}


def changed(before, after):
    return {key for key, value in before.items() if not value.equal(after[key])}


@every_rl
def test_every_update_is_one_of_the_critics_and_every_other_one_of_td3s_actor(name):
    learner = make(name)
    for update in range(1, 7):
        before, slow = weights(learner), targets(learner)
        told = learner.learn(make_batch(2, 1, 16, seed=update))
        now = changed(before, weights(learner))
        critics = {key for key in before if "value_network" in key}
        due = name != "td3" or update % 2 == 0
        assert critics
        assert now == (set(before) if due else critics)
        assert bool(changed(slow, targets(learner))) == due
        assert "loss_actor" in told  # also where it is the latest one


def test_td3_computes_the_actors_loss_only_where_it_is_due(monkeypatch):
    learner, computed, told = make("td3", policy_delay=3), [], []
    loss = learner.loss.loss_actor
    monkeypatch.setattr(
        learner.loss, "loss_actor", lambda batch: computed.append(update) or loss(batch)
    )
    for update in range(1, 8):
        assert learner.actor_is_due == learner.actor_is_due == (update % 3 == 0)  # asking is free
        told.append(learner.learn(make_batch(2, 1, 16, seed=update))["loss_actor"])
    assert computed == [3, 6]
    assert not told[0].any() and not told[1].any()
    assert told[2].equal(told[3]) and told[2].equal(told[4])
    assert (told[4] != told[5]).all() and told[5].equal(told[6])


@every_rl
def test_each_expert_learns_as_it_would_alone_whatever_the_others_see(name):
    """Of one seed: experts are as independent of each other as seeds are."""
    learners = [make(name, seeds=(3,), experts=(0, 5, 2))]
    learners += [make(name, seeds=(3,), experts=(expert,)) for expert in (0, 5, 2)]
    for update in range(6):
        data = make_batch(1, 3, 16, seed=update)
        data[:, 1] = make_batch(1, 16, seed=90 + update)
        for learner, rows in zip(learners, (slice(None), [0], [1], [2]), strict=True):
            learner.learn(data[:, rows].clone())
    together, *alone = [weights(learner) for learner in learners]
    for index, ours in enumerate(alone):
        for key, value in ours.items():
            torch.testing.assert_close(together[key][:, index], value[:, 0], rtol=1e-4, atol=1e-4)


@every_rl
def test_an_expert_without_data_stays_as_it_is(name):
    learner = make(name, experts=(0, 1))
    before, slow = weights(learner), targets(learner)
    weight = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    for update in range(4):
        data = make_batch(2, 2, 16, seed=update)
        learner.learn(data.set("priority_weight", weight.unsqueeze(-1).expand(2, 2, 16)))
    now = weights(learner) | targets(learner)
    for key, value in (before | slow).items():
        if value.ndim > 1:
            assert (now[key] != value).view(2, 2, -1).any(-1).equal(weight > 0), key


@every_rl
@torch.no_grad()
def test_exploration_is_gaussian_or_what_the_policy_draws(name):
    """By that of the expert which is asked for, of three."""
    learner = make(name, experts=(0, 1, 2))
    data, expert = make_batch(2).select("state", "label"), torch.tensor([2, 0])
    action = learner.act(data.clone(), generators(SEEDS, "exploration"), expert)
    noise = torch.stack([torch.randn(4, generator=g) for g in generators(SEEDS, "exploration")])
    told = learner.actor(data.unsqueeze(1).expand(2, 3).clone())[torch.arange(2), expert]
    if name == "sac":
        expected = (told["loc"] + told["scale"] * noise).tanh()
    else:
        expected = (told["action"] + 0.3 * noise).clamp(-1, 1)
    torch.testing.assert_close(action, expected)
    assert not action.equal(told["action"])


@every_rl
def test_the_settings_reach_the_loss(name):
    learner = make(name, gamma=0.5, learning_rate=0.02, tau=0.25, hidden_sizes=(7, 5))
    assert learner.loss.value_estimator.gamma == 0.5
    assert [group["lr"] for group in learner.optimizer.param_groups] == [0.02]
    assert learner.target_update.eps == 0.75
    assert [layer.out_features for layer in learner.actor.mlp.layers][:2] == [7, 5]
    assert learner.loss.return_bounds == (0.0, 1.3)
    assert make(name, clip_targets=False).loss.return_bounds is None
    if name == "sac":
        for counted in (False, True):
            assert make(name, entropy_in_target=counted).loss.entropy_in_target == counted


@pytest.fixture
def make_bgpo(bank, make_config):
    def make_bgpo(rl):
        config = make_config("state", f"oracle+{rl}").algorithm
        return BGPO(config, seeds=SEEDS, bank=bank.seen())

    return make_bgpo


@every_rl
def test_test_episodes_are_without_noise(make_bgpo, bank, name):
    algorithm = make_bgpo(name)
    embedding, task = bank.held_out().embedding.view(3, 4, 32), torch.zeros(3, 4).long()
    policy = Policy.stack(
        [algorithm.snapshot(i, embedding, task, torch.Generator()) for i in range(2)]
    )
    state = torch.randn(2, 3, 4, 16)
    label = torch.tensor([1.0, 0, 0]).expand(2, 3, 4, 3)
    shown = TensorDict({"state": state, "context": label}, [2, 3, 4])
    expected = algorithm.learner.actor(shown.view(2, 1, 12))["action"].view(2, 3, 4, 4)
    first, second = (policy.act(state) for _ in range(2))
    assert first.equal(second)
    torch.testing.assert_close(first, expected)


@pytest.mark.parametrize("name", ["maml", "dist-nll", "ewc"])
def test_what_is_defined_over_ddpg_takes_nothing_else(name):
    config = ALGORITHMS[name].config
    assert config.rl == DDPGConfig()
    with pytest.raises(ValueError, match=r"is defined over DDPG, not 'td3': [^\n]*$"):
        replace(config, rl=TD3Config())


@dataclass(frozen=True)
class OwnConfig(RLConfig):
    name: str = "own"


def test_an_own_algorithm_is_one_entry(make_bgpo, monkeypatch):
    made = []

    def make_own(config, spec):
        made.append((config, spec))
        return make_ddpg(DDPGConfig(hidden_sizes=(5,)), spec)

    monkeypatch.setitem(RL, "own", RLEntry(make_own, OwnConfig()))
    algorithm = make_bgpo("own")
    ((config, spec),) = made
    assert (config.name, config.batch_size) == ("own", 16)
    assert (spec.seeds, spec.in_features) == (SEEDS, 16 + 3)
    assert spec.in_keys == ["state", "context"]
    assert spec.return_bounds == (0.0, 1.0)
    assert algorithm.learner.actor.mlp.layers[0].out_features == 5


def test_a_config_of_no_known_algorithm_is_refused():
    for config in (OwnConfig(), DDPGConfig(name="td3")):
        with pytest.raises(ValueError, match=r"is of no known RL algorithm \(its name is"):
            make_learner(config, LearnerSpec(SEEDS, ["state"], 6, (0.0, 1.0), torch.device("cpu")))
