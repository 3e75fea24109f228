"""Variants of BGPO, steps of training, and comparisons of what was learned."""

import numpy as np
import torch

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
    "all": ("latent", "b", "bgpo"),
}
# More groups than are active.
GROUPS = {"group_size": 4, "group_evidence": 0.5, "active_groups": 2}
CHANGES = {"group-balanced replay": GROUPS, "experts": GROUPS, "all": GROUPS}
SCHEDULE = TaskSchedule((0, 2, 4))


def play(algorithm, n_steps, state=None, hidden=(), watch=lambda chosen: None):
    """Trains for some steps; the algorithm gets none of the `hidden` entries.

    Returns transitions ``[S, T]`` and the tensordict in flight.
    """
    state, transitions = algorithm.world.env.reset() if state is None else state, []
    for _ in range(n_steps):
        state.update(algorithm.act(state.exclude(*hidden)))
        watch(state)
        algorithm.update()
        transition, state = algorithm.world.env.step_and_maybe_reset(state)
        transitions.append(transition.clone())
        algorithm.store(transition.exclude(*hidden, *(("next", key) for key in hidden)))
    return torch.stack(transitions, dim=1), state


def weights(algorithm):
    return list(algorithm.learner.loss.parameters())


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
