"""BGPO as a whole: what it sees, what it learns from, and that seeds share nothing."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from benchmarks import ablation
from bgpo_trl.algorithms.algorithm import observe
from bgpo_trl.algorithms.bgpo import BGPO, labeled, self_organized, untold
from bgpo_trl.demonstration_bank import DemonstrationBank
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import BehaviorLookup, TaskSchedule

# What the policy sees, what it is told, and the composition that tells it.
VARIANTS = {
    "ground truth, label": ("state", "label", labeled),
    "latent, label": ("latent", "label", labeled),
    "latent, nothing": ("latent", "nothing", untold),
    "latent, phi": ("latent", "phi", ablation.VARIANTS["r_int"]),
    "latent, b": ("latent", "b", self_organized),
}
pytestmark = pytest.mark.usefixtures("easy_world")
variants = pytest.mark.parametrize("variant", VARIANTS)
SCHEDULE = TaskSchedule((0, 2, 4))


@pytest.fixture
def make(bank, encoders, make_config):
    def make(variant="latent, b", seeds=(3, 8), schedule=SCHEDULE, bank=bank, **changes):
        state, _, compose = VARIANTS[variant]
        config = replace(make_config(state).algorithm, **changes)
        parts = {"bank": bank.seen(), "encoders": encoders, "compose": compose}
        return BGPO(config, seeds=seeds, schedule=schedule, **parts)

    return make


def play(algorithm, n_steps, hidden=()):
    """Trains for some steps; BGPO gets none of the `hidden` entries. Returns transitions [S, T]."""
    state, transitions = algorithm.env.reset(), []
    for _ in range(n_steps):
        state = algorithm.act(state.exclude(*hidden))
        algorithm.update()
        transition, state = algorithm.env.step_and_maybe_reset(state)
        transitions.append(transition.clone())
        algorithm.store(transition.exclude(*hidden, *(("next", key) for key in hidden)))
    return torch.stack(transitions, dim=1)


def assert_same_graph(first, second, **tolerance):
    for ours, theirs in zip(first, second, strict=True):
        torch.testing.assert_close(ours, theirs, **tolerance)


@variants
@pytest.mark.parametrize("n_tasks", [1, 3])
def test_each_variant_is_an_environment_with_the_input_it_is_named_after(make, variant, n_tasks):
    algorithm = make(variant, schedule=TaskSchedule((0,) * n_tasks))
    before = None if algorithm.gwr is None else algorithm.gwr.graph(0)
    for transform in algorithm.env.transform:
        if isinstance(transform, BehaviorLookup):
            transform.learn = False
    check_env_specs(algorithm.env)

    state, told, _ = VARIANTS[variant]
    sizes = {"state": 16, "latent": 64, "task_one_hot": n_tasks, "normalized_behavior": 32}
    keys = {"label": ["task_one_hot"], "nothing": []}.get(told, ["normalized_behavior"])
    start = algorithm.act(algorithm.env.reset())
    assert algorithm.actor.in_keys == [state, *keys]
    critic = algorithm.loss.value_network
    assert critic.in_keys == [state, *keys, "action"]
    n_features = sum(sizes[key] for key in (state, *keys))
    assert algorithm.actor.mlp.layers[0].in_features == n_features
    assert critic.mlp.layers[0].in_features == n_features + 4
    for key in (state, *keys):
        assert start[key].shape == (2, sizes[key])
    assert start["action"].shape == (2, 4)
    assert ("task_one_hot" in start) == (told == "label")
    assert ("normalized_behavior" in start) == ("behavior" in start) == (told in ("phi", "b"))
    assert ("behavior_node" in start) == (told == "b")
    assert ("lae_h" in start) == (told in ("phi", "b"))
    assert "pixels" not in start
    assert (before is not None) == (told == "b")
    if before is not None:
        assert_same_graph(algorithm.gwr.graph(0), before, rtol=0, atol=0)


def test_what_the_policy_sees_is_in_the_scale_of_latents(make):
    algorithm = make("ground truth, label", max_steps=50)
    seen = play(algorithm, 60)["state"]
    assert seen.abs().max() <= 5
    assert seen.mean((0, 1)).abs().max() < 3
    assert 0.1 < seen.std() < 3


def test_phi_is_the_behavior_where_there_is_no_gwr(make, bank):
    data = play(make("latent, phi"), 20)
    assert data["behavior"].equal(bank.seen().embedding[data["demo_index"]])


def test_a_label_is_the_task_of_the_episode(make):
    data = play(make("latent, label", schedule=TaskSchedule((0, 0, 0))), 30)
    assert data["task_one_hot"].argmax(-1).equal(data["task"])
    assert data["task_one_hot"].sum(-1).unique().tolist() == [1]
    assert data["task"].unique().tolist() == [0, 1, 2]


@pytest.mark.parametrize("variant", ["latent, nothing", "latent, phi", "latent, b"])
def test_bgpo_never_reads_the_label(make, variant):
    label = ("task", "task_one_hot")
    algorithm, blind = make(variant), make(variant)
    for keys in (algorithm.actor.in_keys, algorithm.loss.in_keys, algorithm.replay.keys):
        names = {name for key in keys for name in ([key] if isinstance(key, str) else key)}
        assert names.isdisjoint(label)

    seeing = play(algorithm, 40)
    not_seeing = play(blind, 40, hidden=["task"])

    assert seeing["task"].unique().tolist() == [0, 1, 2]
    behavior = [] if variant == "latent, nothing" else ["behavior"]
    for key in ("action", "latent", *behavior, "demo_index", ("next", "reward")):
        assert seeing[key].equal(not_seeing[key]), key
    for ours, theirs in zip(algorithm.loss.parameters(), blind.loss.parameters(), strict=True):
        assert ours.equal(theirs)
    if algorithm.gwr is not None:
        assert_same_graph(algorithm.gwr.graph(0), blind.gwr.graph(0), rtol=0, atol=0)


@pytest.mark.parametrize("variant", ["ground truth, label", "latent, nothing"])
def test_a_reference_learns_the_same_from_whatever_demonstrations(make, bank, variant):
    other = DemonstrationBank(-3 * bank.embedding.flip(0), bank.task, bank.train)
    algorithm, elsewhere = make(variant), make(variant, bank=other)
    data, changed = play(algorithm, 30), play(elsewhere, 30)
    assert not data["demo_embedding"].equal(changed["demo_embedding"])
    for key in (*algorithm.in_keys, "action", "task", ("next", "reward")):
        assert data[key].equal(changed[key]), key
    for ours, theirs in zip(algorithm.loss.parameters(), elsewhere.loss.parameters(), strict=True):
        assert ours.equal(theirs)


def test_plain_ddpg_acts_and_learns_by_the_state_and_nothing_else(make):
    algorithm, blind = make("latent, nothing"), make("latent, nothing")
    states = [learner.env.reset() for learner in (algorithm, blind)]
    kept = ["latent", "action", *(("next", key) for key in ("latent", "reward", "terminated"))]
    for _ in range(20):
        actions = [algorithm.act(states[0]), blind.act(states[1].select("latent"))]
        assert set(actions[1].keys()) == {"latent", "action"}
        for index, learner in enumerate((algorithm, blind)):
            losses = learner.update()
            chosen = states[index].set("action", actions[index]["action"])
            transition, states[index] = learner.env.step_and_maybe_reset(chosen)
            learner.store(transition.select(*kept) if learner is blind else transition)
        assert actions[0]["action"].equal(actions[1]["action"])
    assert losses
    assert set(algorithm.replay.sample().keys(True, True)) == set(kept)
    for ours, theirs in zip(algorithm.loss.parameters(), blind.loss.parameters(), strict=True):
        assert ours.equal(theirs)


def test_what_is_said_of_a_labeled_task_is_its_place(make):
    """The first layer adds the row of weights that belongs to the label."""
    algorithm = make("latent, label", schedule=TaskSchedule((0, 0, 0)))
    state = algorithm.env.reset()
    first, second = algorithm.actor.mlp.layers
    for index in range(2):
        weight = first.weight[index]
        hidden = state["latent"][index] @ weight[:64] + weight[64 + state["task"][index]]
        hidden = (hidden + first.bias[index]).relu()
        action = (hidden @ second.weight[index] + second.bias[index]).tanh()
        torch.testing.assert_close(algorithm.actor(state.clone())["action"][index], action)


def act_in_tests(algorithm, state, embedding, task):
    frozen = [
        TensorDict(algorithm.freeze(index, embedding, task, torch.Generator()))
        for index in range(algorithm.n_seeds)
    ]
    return algorithm.act_frozen(TensorDict.maybe_dense_stack(frozen), state)


@variants
def test_only_a_variant_with_a_label_acts_by_it(make, bank, variant):
    algorithm = make(variant, schedule=TaskSchedule((0, 0, 0)))
    embedding = bank.held_out().embedding.view(3, 4, 32)
    state = torch.randn(2, 3, 4, algorithm.state_size, generator=torch.Generator().manual_seed(0))
    actions = [
        act_in_tests(algorithm, state, embedding, torch.full((3, 4), task)) for task in (0, 1)
    ]
    assert actions[0].shape == (2, 3, 4, 4)
    assert actions[0].equal(actions[1]) == (VARIANTS[variant][1] != "label")
    other = act_in_tests(algorithm, state, 5 - embedding.flip(0), torch.zeros(3, 4).long())
    assert actions[0].equal(other) == (VARIANTS[variant][1] in ("label", "nothing"))


def test_frozen_policies_are_told_what_training_would_tell_and_learn_nothing(make, bank):
    algorithm = make()
    play(algorithm, 13)
    before = [algorithm.gwr.graph(i) for i in range(2)]
    state = algorithm.env.reset()
    shown = (state["demo_embedding"].unsqueeze(1), state["task"].unsqueeze(1))
    for index in range(2):
        frozen = algorithm.freeze(index, *shown, torch.Generator())
        assert frozen["told"][index, 0].equal(state["normalized_behavior"][index])
        for key, value in algorithm.actor.state_dict().items():
            assert frozen["actor"][key].equal(value[index])
    seen = bank.seen().embedding
    torch.testing.assert_close(
        state["normalized_behavior"] * seen.std(0) + seen.mean(0), state["behavior"]
    )
    for index, graph in enumerate(before):
        assert_same_graph(algorithm.gwr.graph(index), graph, rtol=0, atol=0)


def test_episodes_follow_algorithm_1(make, bank, encoders):
    """Behavior, growth of GWR-B and reward, worked out anew from latents and demonstrations."""
    seeds, phi = (3, 8), bank.seen().embedding
    algorithm = make(seeds=seeds)
    data = play(algorithm, 90)
    for index, seed in enumerate(seeds):
        gwr = GWRB(32, generator=generators([seed], "gwr"))
        trajectory = []
        for step in data[index]:
            b = gwr.lookup(phi[step["demo_index"]]).embedding
            torch.testing.assert_close(step["behavior"], b)
            trajectory.append(step["latent"])
            reward = step["next", "terminated"].float()
            if step["next", "done"]:
                trajectory.append(step["next", "latent"])
                length = torch.tensor([len(trajectory)])
                phi_g = encoders.lae.encode(torch.stack(trajectory)[None], length)[0]
                reward = reward + 0.1 * torch.exp(-torch.linalg.vector_norm(b - phi_g))
                gwr.adapt(phi[step["demo_index"]])
                trajectory = []
            torch.testing.assert_close(step["next", "reward"], reward)
        assert_same_graph(algorithm.gwr.graph(index), gwr.graph())
        assert len(gwr.graph().weights) > 2


@variants
@pytest.mark.parametrize("scale", [0.0, 0.7])
def test_exploration_is_noise_of_each_seed_on_the_policys_action(make, make_config, variant, scale):
    ddpg = replace(make_config().algorithm.rl, noise=scale)
    algorithm, sources = make(variant, rl=ddpg), generators((3, 8), "exploration")
    with torch.no_grad():  # so that some actions are cut off, and some are not
        algorithm.actor.mlp.layers[-1].bias.copy_(torch.tensor([[0.0, 1.0, -1.0, 0.0]]))
    state, n_cut = algorithm.env.reset(), 0
    for _ in range(8):
        action = algorithm.actor(state.clone())["action"]
        state = algorithm.act(state)
        for index, source in enumerate(sources):
            expected = action[index] + scale * torch.randn(4, generator=source)
            n_cut += int((expected.abs() > 1).sum())
            torch.testing.assert_close(state["action"][index], expected.clamp(-1, 1))
        _, state = algorithm.env.step_and_maybe_reset(state)
    assert (0 < n_cut < 64) == (scale > 0)


@pytest.mark.parametrize(
    ("variant", "changes", "highest"),
    [
        ("latent, b", {}, 1.1),
        ("latent, phi", {"beta": 0.3}, 1.3),
        ("latent, b", {"beta": 0.0}, 1.0),
        ("latent, label", {}, 1.0),
        ("latent, nothing", {"beta": 0.3}, 1.0),
    ],
)
def test_targets_are_clipped_to_the_attainable_returns(make, variant, changes, highest):
    algorithm = make(variant, **changes)
    play(algorithm, 7)
    target_bias = [
        value
        for key, value in algorithm.loss.state_dict().items()
        if key.startswith("target_value") and key.endswith("bias")
    ][-1]
    for bias, expected in ((50.0, highest), (-50.0, 0.0)):
        target_bias.fill_(bias)
        batch = algorithm.replay.sample()
        target = algorithm.loss(batch)["target_value"].unsqueeze(-1)
        terminated = batch["next", "terminated"]
        # A success has nothing to come: its return is its reward.
        returns = torch.where(terminated, batch["next", "reward"], expected)
        assert 0 < terminated.float().mean() < 1
        torch.testing.assert_close(target, returns)


def test_clipping_can_be_turned_off(make, make_config):
    ddpg = replace(make_config().algorithm.rl, clip_targets=False)
    assert make(rl=ddpg).loss.return_bounds is None


def test_the_first_update_comes_after_the_warm_up_and_with_the_step_that_follows(make):
    algorithm = make()
    start = [p.detach().clone() for p in algorithm.loss.parameters()]
    play(algorithm, algorithm.config.rl.warmup_steps)
    for value, before in zip(algorithm.loss.parameters(), start, strict=True):
        assert value.equal(before)
    play(algorithm, 1)
    for value, before in zip(algorithm.loss.parameters(), start, strict=True):
        assert not value.equal(before)
    assert len(algorithm.replay) == algorithm.config.rl.warmup_steps + 1


@pytest.mark.parametrize("variant", ["ground truth, label", "latent, nothing", "latent, b"])
def test_each_seed_of_a_batch_learns_as_it_would_alone(make, variant):
    seeds = (1, 2)  # no pixel of theirs is so near an edge that rounding moves it across
    batch = make(variant, seeds=seeds)
    together = play(batch, 60)
    losses = []
    for index, seed in enumerate(seeds):
        alone = make(variant, seeds=(seed,))
        data = play(alone, 60)[0]
        for key in ("task", "demo_index", "step_count", ("next", "terminated")):
            assert together[index][key].equal(data[key]), key
        for key in ("action", *alone.in_keys, ("next", "reward")):
            torch.testing.assert_close(together[index][key], data[key], rtol=1e-4, atol=1e-4)
        for ours, theirs in zip(batch.loss.parameters(), alone.loss.parameters(), strict=True):
            torch.testing.assert_close(ours[index], theirs[0], rtol=1e-4, atol=1e-4)
        if batch.gwr is not None:
            assert_same_graph(batch.gwr.graph(index), alone.gwr.graph(0), rtol=1e-5, atol=1e-5)
            assert len(alone.gwr.graph(0).weights) > 2
        losses.append(alone.update())
    mean = batch.update()
    for key, value in mean.items():
        expected = torch.stack([loss[key] for loss in losses]).mean()
        torch.testing.assert_close(value, expected, rtol=1e-3, atol=1e-4)


@variants
def test_missing_encoders_are_refused(make_config, bank, variant):
    state, _, compose = VARIANTS[variant]
    config = make_config(state).algorithm
    parts = {"seeds": (0,), "schedule": SCHEDULE, "bank": bank.seen(), "compose": compose}
    if state == "state":
        BGPO(config, **parts)
        assert observe(config, None)
    else:
        with pytest.raises(ValueError, match="needs trained encoders"):
            BGPO(config, **parts)


@pytest.mark.parametrize("told", ["phi", "b"])
def test_matching_behaviors_on_ground_truth_is_refused(make_config, bank, encoders, told):
    compose = VARIANTS[f"latent, {told}"][-1]
    config = make_config("state").algorithm
    parts = {"seeds": (0,), "schedule": SCHEDULE, "bank": bank.seen(), "compose": compose}
    with pytest.raises(ValueError, match="matching behaviors needs trained encoders"):
        BGPO(config, **parts)
    with pytest.raises(ValueError, match="found no 'latent'"):
        BGPO(config, encoders=encoders, **parts).env.reset()
