"""BGPO as a whole: what it sees, what it learns from, and that seeds share nothing."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torchrl.envs import check_env_specs

from bgpo_trl.algorithms.bgpo import BGPO, observe
from bgpo_trl.configs import BGPOConfig
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.seeding import generators
from bgpo_trl.transforms import BehaviorLookup, TaskSchedule

VARIANTS = {
    "ground truth, label": ("state", "task_one_hot"),
    "latent, label": ("latent", "task_one_hot"),
    "latent, phi": ("latent", "demo_embedding"),
    "latent, b": ("latent", "behavior"),
}
pytestmark = pytest.mark.usefixtures("easy_world")
variants = pytest.mark.parametrize("variant", VARIANTS)
SCHEDULE = TaskSchedule((0, 2, 4))


@pytest.fixture
def make(bank, encoders, make_config):
    def make(variant="latent, b", seeds=(3, 8), schedule=SCHEDULE, **changes):
        state, context = VARIANTS[variant]
        config = replace(make_config(state, context).bgpo, **changes)
        return BGPO(config, seeds=seeds, schedule=schedule, bank=bank.seen(), encoders=encoders)

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

    state, context = VARIANTS[variant]
    sizes = {"state": 16, "latent": 64, "task_one_hot": n_tasks}
    key = "task_one_hot" if context == "task_one_hot" else "normalized_behavior"
    start = algorithm.act(algorithm.env.reset())
    assert algorithm.actor.in_keys == [state, key]
    assert algorithm.actor.mlp.layers[0].in_features == sizes[state] + sizes.get(context, 32)
    assert start[state].shape == (2, sizes[state])
    assert start[key].shape == (2, sizes.get(context, 32))
    assert start["action"].shape == (2, 4)
    assert ("behavior_node" in start) == (context == "behavior")
    assert ("lae_h" in start) == (context != "task_one_hot")
    assert "pixels" not in start
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


@pytest.mark.parametrize("variant", ["latent, phi", "latent, b"])
def test_bgpo_never_reads_the_label(make, variant):
    label = ("task", "task_one_hot")
    algorithm, blind = make(variant), make(variant)
    for keys in (algorithm.actor.in_keys, algorithm.loss.in_keys, algorithm.replay.keys):
        names = {name for key in keys for name in ([key] if isinstance(key, str) else key)}
        assert names.isdisjoint(label)

    told = play(algorithm, 40)
    untold = play(blind, 40, hidden=["task"])

    assert told["task"].unique().tolist() == [0, 1, 2]
    for key in ("action", "latent", "behavior", "demo_index", ("next", "reward")):
        assert told[key].equal(untold[key]), key
    for ours, theirs in zip(algorithm.loss.parameters(), blind.loss.parameters(), strict=True):
        assert ours.equal(theirs)
    if algorithm.gwr is not None:
        assert_same_graph(algorithm.gwr.graph(0), blind.gwr.graph(0), rtol=0, atol=0)


@variants
def test_only_a_variant_with_a_label_acts_by_it(make, variant):
    algorithm = make(variant, schedule=TaskSchedule((0, 0, 0)))
    state = algorithm.env.reset()
    embedding = state["demo_embedding"].unsqueeze(1)
    first = algorithm.infer(embedding, torch.zeros(2, 1, dtype=torch.int64))
    other = algorithm.infer(embedding, torch.ones(2, 1, dtype=torch.int64))
    key = algorithm.in_keys[1]
    actions = [algorithm.actor(state.clone().set(key, b[:, 0]))["action"] for b in (first, other)]
    assert actions[0].equal(actions[1]) == (key == "normalized_behavior")


def test_inference_is_the_lookup_of_the_algorithm_and_learns_nothing(make, bank):
    algorithm = make()
    play(algorithm, 13)
    before = [algorithm.gwr.graph(i) for i in range(2)]
    state = algorithm.env.reset()
    inferred = algorithm.infer(state["demo_embedding"].unsqueeze(1), state["task"].unsqueeze(1))
    assert inferred.squeeze(1).equal(state["normalized_behavior"])
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


def expect(algorithm, value):
    """Has the critic expect the same of whatever is done."""
    with torch.no_grad():
        algorithm.critic.mlp.layers[-1].weight.zero_()
        algorithm.critic.mlp.layers[-1].bias.fill_(value)


@pytest.mark.parametrize(("value", "policy"), [(0.0, 0.0), (-1.0, 0.0), (0.25, 1.0), (0.9, 1.0)])
def test_exploration_is_noise_of_each_seed_on_the_policy_or_alone(make, value, policy):
    config = make().config
    algorithm = make(ddpg=replace(config.ddpg, exploratory_share=1.0))
    expect(algorithm, value)
    state = algorithm.env.reset()
    action = algorithm.actor(state.clone())["action"]
    explored = algorithm.act(state)["action"]
    for index, source in enumerate(generators((3, 8), "exploration")):
        torch.rand((), generator=source)
        noise = config.ddpg.noise * torch.randn(4, generator=source)
        torch.testing.assert_close(explored[index], (policy * action[index] + noise).clamp(-1, 1))
    with torch.no_grad():
        algorithm.actor.mlp.layers[-1].bias.fill_(9)
    assert (algorithm.act(algorithm.env.reset())["action"].max() == 1) == bool(policy)


@pytest.mark.parametrize(("value", "share"), [(0.0, 0.5), (0.125, 0.25), (0.3, 0.0)])
def test_the_less_is_expected_the_more_episodes_explore(make, value, share):
    algorithm = make()
    expect(algorithm, value)
    with torch.no_grad():
        algorithm.actor.mlp.layers[-1].bias.fill_(9)  # tells policy from noise
    start = algorithm.env.reset()
    drawn = torch.stack([(algorithm.act(start)["action"] < 0.1).any(-1) for _ in range(300)])
    assert drawn.float().mean().item() == pytest.approx(share, abs=0.07)


def test_what_an_episode_does_is_drawn_at_its_start_only(make):
    algorithm = make(max_steps=50)
    expect(algorithm, 0.0)
    with torch.no_grad():
        algorithm.actor.mlp.layers[-1].bias.fill_(9)
    data = play(algorithm, 120)
    by_policy = data["action"].mean(-1) > 0.5  # of four parts around 0.9, or around 0
    kinds = set()
    for row in range(2):
        firsts = (data["step_count"][row, :, 0] == 0).nonzero().flatten().tolist()
        for first, end in pairwise([*firsts, 120]):
            assert by_policy[row, first:end].unique().numel() == 1
            kinds.add(by_policy[row, first].item())
    assert kinds == {True, False}


@pytest.mark.parametrize(
    ("variant", "changes", "highest"),
    [
        ("latent, b", {}, 1.1),
        ("latent, phi", {"beta": 0.3}, 1.3),
        ("latent, b", {"beta": 0.0}, 1.0),
        ("latent, label", {}, 1.0),
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
    ddpg = replace(make_config().bgpo.ddpg, clip_targets=False)
    assert make(ddpg=ddpg).loss.return_bounds is None


def test_the_first_update_comes_after_the_warm_up_and_with_the_step_that_follows(make):
    algorithm = make()
    start = [p.detach().clone() for p in algorithm.loss.parameters()]
    play(algorithm, algorithm.config.ddpg.warmup_steps)
    for value, before in zip(algorithm.loss.parameters(), start, strict=True):
        assert value.equal(before)
    play(algorithm, 1)
    for value, before in zip(algorithm.loss.parameters(), start, strict=True):
        assert not value.equal(before)
    assert len(algorithm.replay) == algorithm.config.ddpg.warmup_steps + 1


@pytest.mark.parametrize("variant", ["ground truth, label", "latent, b"])
def test_each_seed_of_a_batch_learns_as_it_would_alone(make, variant):
    seeds = (3, 8)
    batch = make(variant, seeds=seeds)
    together = play(batch, 60)
    losses = []
    for index, seed in enumerate(seeds):
        alone = make(variant, seeds=(seed,))
        data = play(alone, 60)[0]
        for key in ("task", "demo_index", "step_count", ("next", "terminated")):
            assert together[index][key].equal(data[key]), key
        for key in ("action", alone.in_keys[0], alone.in_keys[1], ("next", "reward")):
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
    state, context = VARIANTS[variant]
    config = make_config(state, context).bgpo
    parts = {"seeds": (0,), "schedule": SCHEDULE, "bank": bank.seen()}
    if state == "state":
        BGPO(config, **parts)
        assert observe(config, None, 3)
    else:
        with pytest.raises(ValueError, match="needs trained encoders"):
            BGPO(config, **parts)


@pytest.mark.parametrize("context", ["behavior", "demo_embedding"])
def test_ground_truth_without_a_label_is_refused(context):
    with pytest.raises(ValueError, match="goes with context='task_one_hot' only"):
        BGPOConfig(state="state", context=context)
