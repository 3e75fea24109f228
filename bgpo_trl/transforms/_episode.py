"""Base classes of the transforms that write at the start of an episode and act at its end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    FrameSkipTransform,
    MultiAction,
    RandomTruncationTransform,
    RewardSum,
    StepCounter,
    TerminateTransform,
    Transform,
    TransformedEnv,
)

from bgpo_trl.seeding import Seeding

_ENDING = (StepCounter, TerminateTransform, RandomTruncationTransform)  # which end episodes


def starting(tensordict: TensorDictBase) -> Tensor:
    """Return the rows that this reset starts, bool ``[*B]``; all if there is no ``_reset``."""
    reset = tensordict.get("_reset", None)
    if reset is None:
        return torch.ones(tensordict.batch_size, dtype=torch.bool, device=tensordict.device)
    return reset.reshape(tensordict.batch_size)


def ending(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
    """Return the rows whose episode ends with this step, bool ``[*B]``.

    A row that is stepped after its end, or skipped by a partial step, does not end again.
    """
    done = next_tensordict.get("done")
    was_done = tensordict.get("done", None)
    ended = done if was_done is None else done & ~was_done
    return ended.reshape(next_tensordict.batch_size)


class EpisodeTransform(Transform):
    """Base of the transforms whose entries are set at reset and copied from step to step.

    An episode is that of a row: it ends with ``done`` ``[*B, 1]``, the environment's own, not one
    of several agents. The entries must stay in the observation, since the next step reads them.
    ``StepCounter`` must come before the transform, so that ``done`` includes time-outs, and within
    the same process: an end that workers or a collector's ``max_frames_per_traj`` add outside is
    not seen. A transform that acts at the end of episodes requires a ``StepCounter``. ``RewardSum``
    must come after a transform that changes the reward.

    One seed for all: TorchRL's ``TransformedEnv.set_seed`` reaches only the base environment.
    `NicoEnv` therefore records its last ``set_seed``, and a transform that draws at random looks
    there before each reset: a new seed takes effect on the transform and on the simulation at the
    same reset, also in each worker of a ``ParallelEnv``. With any other base environment, call
    `seed_rows`.

    Attributes:
        reads: Entries read; TorchRL's ``RenameTransform`` serves environments with other names.
        writes: Entries written.
        learn: Whether it learns at the end of an episode.
        acts_at_end: Whether it acts at the end of an episode even if it does not learn.
        changes_reward: Whether it changes the reward.
    """

    reads: ClassVar[Sequence[str]] = ()
    writes: ClassVar[Sequence[str]] = ()
    learn: bool = False
    acts_at_end: bool = False
    changes_reward: bool = False
    _seeding: Seeding | None = None

    def __init__(self) -> None:
        super().__init__(in_keys=[*self.reads], out_keys=[*self.writes])

    def seed_rows(self, seeds: Sequence[int]) -> None:
        """Start random streams anew, from a seed for each row; this base class has none."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Raise ``TypeError``: outside an environment, there are no episodes to act on."""
        raise TypeError(f"{type(self).__name__} needs episodes: append it to an environment")

    def _follow_seed(self) -> None:
        try:
            env = self.container
        except ValueError:  # in a replay buffer, which TorchRL does not take for a container
            return
        while isinstance(env, TransformedEnv):
            env = env.base_env
        # Not getattr, with which a ParallelEnv would ask its workers.
        seeding = None if env is None else vars(env).get("seeding")
        if seeding is not None and seeding is not self._seeding:
            self.seed_rows(seeding.seeds)
        self._seeding = seeding

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        self._follow_seed()  # A seed set earlier must not undo the load at the next reset.
        super()._load_from_state_dict(*args, **kwargs)

    def _entries(self, observation_spec: Composite) -> dict[str, TensorSpec]:
        """Return the specs of the entries written, given the observation so far."""
        raise NotImplementedError

    def _read_spec(self, observation_spec: Composite, key: str, source: str) -> TensorSpec:
        if key not in observation_spec.keys(True, True):
            raise ValueError(f"{type(self).__name__} found no {key!r}: put {source} before it")
        return observation_spec[key]

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        # Specs are made on demand. Making them before the reset reports a wrong composition by its
        # cause.
        observation_spec = cast(EnvBase, self.container).observation_spec
        self._check_limit(observation_spec)  # again, since `learn` may have changed
        self._follow_seed()
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the entries of this transform.

        Raises:
            ValueError: If transforms are in the wrong order, or it acts at the end of episodes
                without a ``StepCounter``.
        """
        self._check_order(observation_spec)
        for key, spec in self._entries(observation_spec).items():
            observation_spec[key] = spec
        self._check_limit(observation_spec)
        return observation_spec

    def _check_order(self, observation_spec: Composite) -> None:
        before, after = self._others()
        late = next((t for t in after if isinstance(t, _ENDING)), None)
        if late is not None:
            raise ValueError(
                f"put {type(late).__name__} before {type(self).__name__}, which has to see where "
                "episodes end"
            )
        skips = any(isinstance(t, FrameSkipTransform) for t in after)
        if skips or any(isinstance(t, MultiAction) for t in before):
            order = "FrameSkipTransform before" if skips else "MultiAction after"
            raise ValueError(f"put {order} {type(self).__name__}, which has to see each step once")
        sums = any(isinstance(t, RewardSum) for t in before)
        if self.changes_reward and (sums or "episode_reward" in _names(observation_spec)):
            raise ValueError(f"put RewardSum after {type(self).__name__}, which changes the reward")

    def _check_limit(self, observation_spec: Composite) -> None:
        if not (self.learn or self.acts_at_end) or not isinstance(self.container, TransformedEnv):
            return
        counted = any(isinstance(t, StepCounter) for t in self._others()[0])
        if counted or "step_count" in _names(observation_spec):
            return
        raise ValueError(
            f"{type(self).__name__} acts when episodes end: put StepCounter(50) before it, or "
            "StepCounter() if the environment has its own time limit"
        )

    def _others(self) -> tuple[list[nn.Module], list[nn.Module]]:
        """Return the transforms before and after this one, also of wrapped environments."""
        env, transforms = self.container, list[nn.Module]()
        while isinstance(env, TransformedEnv):
            transforms = [*_flat(env.transform), *transforms]
            env = env.base_env
        at = transforms.index(self) if transforms else 0
        return transforms[:at], transforms[at + 1 :]


def _names(spec: Composite) -> set[str]:
    """Return the names of entries, by which transforms within the workers of an env show."""
    return {key if isinstance(key, str) else key[-1] for key in spec.keys(True)}


def _flat(transform: nn.Module) -> Iterator[nn.Module]:
    if isinstance(transform, Compose):
        for part in transform.transforms:
            yield from _flat(part)
    else:
        yield transform


def unbounded(observation_spec: Composite, *shape: int, dtype: torch.dtype) -> Unbounded:
    """Return the spec of an entry of shape ``[*B, *shape]``."""
    size = torch.Size((*observation_spec.shape, *shape))
    return Unbounded(size, device=observation_spec.device, dtype=dtype)
