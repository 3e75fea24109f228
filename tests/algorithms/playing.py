"""Variants of BGPO, steps of training, and comparisons of what was learned."""

import statistics

import numpy as np
import torch
from tensordict import TensorDict
from torch.nn.functional import layer_norm

from bgpo_trl.configs import RLConfig
from bgpo_trl.transforms import TaskSchedule

# By name: state, meaning of the context, and the algorithm whose settings it has.
VARIANTS = {
    "ground truth, label": ("state", "label", "oracle"),
    "latent, label": ("latent", "label", "oracle"),
    "latent, nothing": ("latent", "nothing", "ddpg"),
    "latent, phi": ("latent", "phi", "without-gwr"),
    "latent, b": ("latent", "b", "bgpo-single"),
    "group-balanced replay": ("latent", "b", "group-balanced-replay"),
    "experts": ("latent", "b", "bgpo-experts"),
    "clone": ("latent", "b", "clone"),
    "all": ("latent", "b", "bgpo"),
}
# More groups than are active.
GROUPS = {"group_size": 4, "group_evidence": 0.5, "active_groups": 2}
CHANGES = dict.fromkeys(("group-balanced replay", "experts", "clone", "all"), GROUPS)
SCHEDULE = TaskSchedule((0, 2, 4))


def make_batch(*shape, seed=0):
    """Transitions of noise, of which a fifth succeed, and actions of noise to imitate."""
    generator = torch.Generator().manual_seed(seed)

    def draw(size):
        return torch.randn(*shape, size, generator=generator)

    ended = torch.rand(*shape, 1, generator=generator) < 0.2
    following = {"state": draw(6), "terminated": ended, "done": ended, "reward": ended.float()}
    data, shown = (
        {"state": draw(6), "label": draw(2), "action": draw(4).clamp(-1, 1)} for _ in range(2)
    )
    return TensorDict({**data, "imitation": shown, "next": following}, shape)


def play(algorithm, n_steps, state=None, hidden=(), watch=lambda chosen: None, boundaries=None):
    """Trains for some steps; the algorithm gets none of the `hidden` entries.

    Tasks begin after the steps that ``boundaries`` names, each as the position of a seed and the
    task. Returns transitions ``[S, T]`` and the tensordict in flight.
    """
    state, transitions = algorithm.world.env.reset() if state is None else state, []
    for step in range(n_steps):
        state.update(algorithm.act(state.exclude(*hidden)))
        watch(state)
        algorithm.update()
        transition, state = algorithm.world.env.step_and_maybe_reset(state)
        transitions.append(transition.clone())
        algorithm.store(transition.exclude(*hidden, *(("next", key) for key in hidden)))
        for index, task in (boundaries or {}).get(step, ()):
            algorithm.begin_task(index, task)
    return torch.stack(transitions, dim=1), state


def snapshot(algorithm, index, embedding=0.0, seed=0):
    """The policy of a seed for two test episodes of each task, all shown the same embedding."""
    shape = (algorithm.n_tasks, 2)
    task = torch.arange(algorithm.n_tasks).unsqueeze(1).expand(shape)
    generator = torch.Generator().manual_seed(seed)
    return algorithm.snapshot(index, torch.full((*shape, 32), embedding), task, generator)


def weights(algorithm):
    return list(algorithm.learner.loss.parameters())


def weights_of(parameters, *index):
    """Copies of the weights of one network of a stack, by name."""
    flat = dict(parameters.flatten_keys(".").items())
    return {key: value.detach()[index].clone() for key, value in flat.items()}


def perceptron(weights, x, normalize=False):
    """The output of a network with one hidden layer, from its weights by name."""
    hidden = x @ weights["mlp.layers.0.weight"] + weights["mlp.layers.0.bias"]
    hidden = layer_norm(hidden, hidden.shape[-1:]) if normalize else hidden
    return hidden.relu() @ weights["mlp.layers.1.weight"] + weights["mlp.layers.1.bias"]


def choice(actor, clone, critics, x, only_clone=False, caution=RLConfig.caution):
    """The action of two proposals that critics choose in one state, from each network's weights."""
    own, cloned = (perceptron(network, x).tanh() for network in (actor, clone))

    def value(critic, action):
        return float(perceptron(critic, torch.cat([x, action]), normalize=True))

    gains = [value(critic, own) - value(critic, cloned) for critic in critics]
    sure = statistics.mean(gains) > caution * statistics.stdev(gains)
    return own if sure and not only_clone else cloned


def assert_same(first, second):
    """Two nested states, bit for bit."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        first, second = list(first.values()), list(second.values())
    if isinstance(first, (list, tuple)):
        for ours, theirs in zip(first, second, strict=True):
            assert_same(ours, theirs)
    elif isinstance(first, torch.Tensor):
        assert first.equal(second)
    else:
        np.testing.assert_equal(first, second)
