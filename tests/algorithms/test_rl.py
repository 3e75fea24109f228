"""The learner: how it explores and updates."""

from dataclasses import replace

import pytest
import torch

from bgpo_trl.algorithms.rl import LearnerSpec, make_learner
from bgpo_trl.configs import SHOWN, RLConfig
from bgpo_trl.seeding import generators
from tests.algorithms.playing import choice, make_batch, perceptron, weights_of

KINDS = {"actor": RLConfig(), "clone": replace(SHOWN, proposals="clone"), "both": SHOWN}
every_kind = pytest.mark.parametrize("name", KINDS)  # of proposals
SEEDS = (3, 8)


def make(name, seeds=SEEDS, experts=(0,), **changes):
    config = replace(KINDS[name], **{"hidden_sizes": (16,), **changes})
    spec = LearnerSpec(seeds, ["state", "label"], 6 + 2, (0.0, 1.3), torch.device("cpu"), experts)
    return make_learner(config, spec)


def weights(learner):
    return {key: value.clone() for key, value in learner.loss.named_parameters()}


def targets(learner):
    return {key: v.clone() for key, v in learner.loss.state_dict().items() if "target_" in key}


def changed(before, after):
    return {key for key, value in before.items() if not value.equal(after[key])}


@every_kind
def test_every_update_is_one_of_critics_and_clone_and_every_other_one_of_the_actor(name):
    """By default; a clone alone has no critics, and DDPG updates its actor always."""
    learner = make(name)
    for update in range(1, 7):
        before, slow = weights(learner), targets(learner)
        told = learner.learn(make_batch(2, 1, 16, seed=update))
        now = changed(before, weights(learner))
        due = name != "both" or update % 2 == 0
        parts = {"actor": "av", "clone": "c", "both": "avc" if due else "vc"}[name]
        assert now == {key for key in before if key[0] in parts}
        moved = {key.removeprefix("target_")[0] for key in changed(slow, targets(learner))}
        followed = "" if name == "clone" else "v" if name == "both" and update == 1 else "av"
        assert moved == {*followed}
        losses = {"a": "loss_actor", "v": "loss_value", "c": "loss_clone"}
        assert {losses[part] for part in parts} == told.keys()
        assert all(value.shape == (2,) for value in told.values())


def test_a_critic_loss_of_ones_own_leaves_the_actor_and_the_pairs_their_turns(monkeypatch):
    learner, pairs = make("both"), []
    loss = learner.loss

    def huber(batch):
        with torch.no_grad():
            target = loss.target(batch)
        pairs.append(loss.pair)
        values = loss.values("value_network", batch)
        distance = torch.nn.functional.smooth_l1_loss(values, target.unsqueeze(2).expand_as(values))
        return distance.expand(2, 1), {}

    monkeypatch.setattr(loss, "loss_value", huber)
    for update in range(1, 11):
        before = weights(learner)
        learner.learn(make_batch(2, 1, 16, seed=update))
        assert any(key[0] == "a" for key in changed(before, weights(learner))) == (update % 2 == 0)
    assert len({*pairs}) == 10
    monkeypatch.setattr(loss, "loss_value", lambda batch: (torch.zeros(2, 1), {}))
    with pytest.raises(RuntimeError, match=r"loss_value must call self\.target once"):
        learner.learn(make_batch(2, 1, 16))


@every_kind
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


@every_kind
def test_new_places_are_copies_of_the_first_expert_without_moments(name):
    learner = make(name, experts=(0, 1))
    learner.learn(make_batch(2, 2, 16))
    before = [[learner.read(seed, slot) for slot in (0, 1)] for seed in (0, 1)]
    learner.resize(3)
    for seed, experts in enumerate(before):
        for slot, expected in enumerate([*experts, {**experts[0], "moments": None}]):
            found = learner.read(seed, slot)
            if expected["moments"] is None:
                expected["moments"] = {k: 0 * value for k, value in found["moments"].items()}
            torch.testing.assert_close(found, expected, rtol=0, atol=0)
    learner.resize(1)
    torch.testing.assert_close(learner.read(1, 0), before[1][0], rtol=0, atol=0)


@every_kind
def test_tests_act_with_averages_of_the_weights_of_updates_with_data(name):
    """Of about the last tenth of the updates, and at last of the last five."""
    learner = make(name, experts=(0, 1), averaging=0.2)
    seed, expert = torch.tensor([[0, 0], [1, 1]]), torch.tensor([[0, 1], [0, 1]])
    averages = learner.policy_weights(seed, expert)
    updates, latest = torch.zeros(2, 2), averages
    for update in range(60):
        data = make_batch(2, 2, 4, seed=update)
        with_data = torch.tensor([[1.0, 1.0], [1.0, update % 3 == 0]])
        given = with_data.unsqueeze(-1).expand(2, 2, 4)
        data["priority_weight"] = data["imitation", "priority_weight"] = given
        learner.learn(data)
        updates += with_data
        latest = learner.policy_weights(seed, expert)
        for place in map(tuple, with_data.nonzero().tolist()):
            share = max(0.2, min(1.0, 10 / updates[place].item()))
            for key, average in averages.items():
                if key != "only_clone" and "critic" not in key:
                    average[place] = average[place].lerp(latest[key][place], share)
    averages |= {key: value for key, value in latest.items() if "critic" in key}
    found = learner.policy_weights(seed, expert, averaged=True)
    torch.testing.assert_close(found, averages)
    of_one = learner.expert_weights(learner.read(1, 1))
    torch.testing.assert_close(of_one, {key: value[1, 1] for key, value in found.items()})
    first = next(iter(found))
    assert not found[first].allclose(learner.policy_weights(seed, expert)[first])


@every_kind
def test_an_expert_without_data_stays_as_it_is(name):
    learner = make(name, experts=(0, 1))
    before, slow = weights(learner), targets(learner)
    weight = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    for update in range(4):
        data = make_batch(2, 2, 16, seed=update)
        given = weight.unsqueeze(-1).expand(2, 2, 16)
        data["priority_weight"] = data["imitation", "priority_weight"] = given
        learner.learn(data)
    now = weights(learner) | targets(learner)
    for key, value in (before | slow).items():
        if value.ndim > 1:
            learns = weight > 0 if name != "clone" or key.startswith("clone") else weight < 0
            assert (now[key] != value).view(2, 2, -1).any(-1).equal(learns), key


@every_kind
def test_exploration_adds_noise_to_the_action_of_the_expert_that_is_asked_for(name):
    """To the better proposal, but in a seed in which the clone is to act."""
    learner, expert, own = make(name, experts=(0, 1, 2)), torch.tensor([2, 0]), set()
    loss, sources, streams = learner.loss, *(generators(SEEDS, "exploration") for _ in range(2))
    for step in range(40):
        data = make_batch(2, seed=step).select("state", "label")
        action = learner.act(data, sources, expert, torch.tensor([False, True]))
        for seed, of_seed in enumerate(expert.tolist()):
            x = torch.cat([data["state"][seed], data["label"][seed]])
            actor, clone = (
                weights_of(getattr(loss, f"{part}_network_params"), seed, of_seed)
                if name in (part, "both")
                else None
                for part in ("actor", "clone")
            )
            if name == "both":
                parameters = loss.target_value_network_params
                critics = [weights_of(parameters, seed, of_seed, n) for n in range(5)]
                best = choice(actor, clone, critics, x, only_clone=seed == 1)
                own.add((seed, best.equal(perceptron(actor, x).tanh())))
            else:
                best = perceptron(actor or clone, x).tanh()
            noise = learner.config.noise * torch.randn(4, generator=streams[seed])
            torch.testing.assert_close(action[seed], (best + noise).clamp(-1, 1))
    assert own == ({(0, True), (0, False), (1, False)} if name == "both" else set())


@every_kind
def test_the_settings_reach_the_loss(name):
    learner = make(name, gamma=0.5, learning_rate=0.02, tau=0.25, hidden_sizes=(7, 5), critics=3)
    assert learner.loss.value_estimator.gamma == 0.5
    assert [group["lr"] for group in learner.optimizer.param_groups] == [0.02]
    assert learner.target_update.eps == 0.75
    assert [layer.out_features for layer in learner.loss.actor_network.mlp.layers][:2] == [7, 5]
    assert learner.loss.n_critics == 3
    assert learner.loss.return_bounds == (0.0, 1.3)
    assert make(name, clip_targets=False).loss.return_bounds is None
