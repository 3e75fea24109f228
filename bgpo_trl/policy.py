"""One-shot use of a trained run: condition its policy on a demonstration and let it act."""

from __future__ import annotations

import importlib
import importlib.util
import json
import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx
from torchrl.envs import Compose

from bgpo_trl.algorithms import Algorithm, entry
from bgpo_trl.algorithms.algorithm import Policy
from bgpo_trl.algorithms.observation import bound, encode
from bgpo_trl.configs import RunConfig
from bgpo_trl.data.bank import DemonstrationBank
from bgpo_trl.data.dataset import resize_frames
from bgpo_trl.encoders.mismatch import doubt_frames
from bgpo_trl.encoders.representation import Representation, embed_demonstrations
from bgpo_trl.files.writing import make_folder, write_whole
from bgpo_trl.runs.config_file import read_config, settings_of
from bgpo_trl.runs.demonstrations import load_inputs
from bgpo_trl.runs.directory import differing_settings, fitting_checkpoint, read_checkpoint
from bgpo_trl.runs.results import read_json
from bgpo_trl.scenes import find_scene
from bgpo_trl.seeding import stream_seed


@dataclass(frozen=True)
class Recognition:
    """Behavior and group that a policy recognizes in a demonstration.

    Attributes:
        embedding: phi of the demonstration, float32 ``[32]``.
        behavior: Weights b of the best-matching node of GWR-B, ``[32]``; None without GWR-B, as are
            the next two.
        node: Identity of that node.
        activity: Activity of that node in [0, 1]; 1 for a demonstration equal to it.
        group: Number of the group of behaviors; None without groups, as are the next two.
        group_novelty: Distance to the group's demonstrations, relative to the group's own extent.
        known: Whether it lies within that extent, so that the novelty is at most 1. It is reliable
            for encoders that have seen the task; of a task new to them, most demonstrations count
            as known.
        task: The label given with the demonstration.
    """

    embedding: Tensor = field(repr=False)
    behavior: Tensor | None = field(default=None, repr=False)
    node: int | None = None
    activity: float | None = None
    group: int | None = None
    group_novelty: float | None = None
    known: bool | None = None
    task: str | None = None


@dataclass(frozen=True)
class LoadedRun:
    """All seeds of a run, as left by its last checkpoint. It can be pickled, without a replay.

    Attributes:
        episodes: Training episodes of each seed so far.
    """

    config: RunConfig
    algorithm: Algorithm
    encoders: Representation
    bank: DemonstrationBank
    episodes: Sequence[int]

    @classmethod
    def restore(
        cls,
        make: Callable[..., Algorithm],
        config: RunConfig,
        state: dict[str, Any],
        encoders: Representation,
        bank: DemonstrationBank,
        episodes: Sequence[int],
    ) -> LoadedRun:
        """Make the algorithm of a run from its state, without a replay that it does not need."""
        algorithm = make(
            config.algorithm,
            seeds=config.seeds,
            bank=bank.seen(config.demonstrations),
            encoders=encoders,
            scene=find_scene(config.scene),
        )
        if not algorithm.needs_replay and hasattr(algorithm, "replay"):
            state = {**state, "replay": algorithm.replay.state_dict()}  # avoids reading it
        algorithm.load_state_dict(state)
        return cls(config, algorithm, encoders, bank, episodes)

    def __reduce__(self) -> tuple[Any, ...]:
        state = self.algorithm.state_dict()
        if not self.algorithm.needs_replay:
            state.pop("replay", None)
        parts = (type(self.algorithm), self.config, state, self.encoders, self.bank, self.episodes)
        return LoadedRun.restore, parts


class TrainedPolicy:
    """The policy of one seed of a run, without learning or noise, as returned by `load_run`.

    It can be pickled, for worker processes. An algorithm of one's own has to take the arguments of
    `Algorithm` alone for that.
    """

    def __init__(self, run: LoadedRun, seed: int) -> None:
        self._run, self.seed = run, seed
        self.config, self.algorithm = run.config, run.algorithm
        self.encoders, self.bank, self.tasks = run.encoders, run.bank, run.config.tasks
        self._index = run.config.seeds.index(seed)
        self.episodes = run.episodes[self._index]
        config = run.config.algorithm
        self._joints = run.algorithm.joints
        self._observe = Compose([encode(config, run.encoders), *bound(config, self._joints)])
        self._policy: Policy | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        shown = None if self._policy is None else self._policy.state_dict()
        return TrainedPolicy, (self._run, self.seed), shown

    def __setstate__(self, shown: dict[str, Any]) -> None:
        self._policy = self.algorithm.policy(**shown)

    @torch.no_grad()
    def condition(
        self,
        demonstration: ArrayLike,
        *,
        task: str | None = None,
        generator: torch.Generator | None = None,
    ) -> Recognition:
        """Condition the policy on a demonstration, complete or truncated.

        Args:
            demonstration: Frames, uint8 ``[T, H, W, 3]``, T at least 1; NICO's are 32 x 64. Warns
                if there are more than an episode of the scene has, or if `doubt_frames` does.
            task: Task label, for algorithms that need it; ignored by others.
            generator: Source of MAML's draws for adaptation; None: derived from the seed.

        Returns:
            The recognized behavior and group.

        Raises:
            ValueError: If the frames have another dtype or shape, or the label is unknown or
                missing; the policy is unchanged then.
        """
        frames = self._frames(demonstration, "a demonstration is uint8 [T, {}], T at least 1", 4)
        scene = find_scene(self.config.scene)
        if len(frames) > scene.max_steps + 1:
            warnings.warn(
                f"the demonstration has {len(frames)} frames, an episode of the scene at most "
                f"{scene.max_steps + 1}: give as many frames a second as the scene has steps",
                stacklevel=3,  # of the call before no_grad's
            )
        if doubt := doubt_frames(self.encoders.frame_network, frames[:: len(frames) // 4 + 1]):
            warnings.warn(doubt, stacklevel=3)
        algorithm, index = self.algorithm, self._index
        if task is None and algorithm.needs_label:
            raise ValueError(
                f"{self.config.name} does not infer the task: name it, task=... as one of "
                f"{', '.join(self.tasks)}"
            )
        label = task if algorithm.needs_label else self.tasks[0]
        if label not in self.tasks:
            raise ValueError(f"no task {task!r} in this run; choose one of {', '.join(self.tasks)}")
        shown = {"pixels": frames.unsqueeze(0), "length": torch.tensor([len(frames)])}
        (embedding,) = embed_demonstrations(self.encoders, TensorDict(shown, [1]))
        if generator is None:
            generator = torch.Generator().manual_seed(stream_seed(self.seed, "one-shot"))
        number = torch.tensor(self.tasks.index(label))
        policy = algorithm.snapshot(index, embedding, number, generator)
        self._policy = policy.to(algorithm.device)
        given, recognized = algorithm.condition(index, embedding, number), dict[str, Any]()
        if algorithm.gwr is not None:
            match = algorithm.gwr.lookup(embedding.expand(algorithm.n_seeds, -1))
            recognized["behavior"], recognized["node"] = given["behavior"], int(match.node[index])
            recognized["activity"] = float(match.activity[index])
        if algorithm.groups:
            recognized["group"] = int(given["group"])
            recognized["group_novelty"] = float(given["group_novelty"])
            recognized["known"] = recognized["group_novelty"] <= 1.0
        return Recognition(embedding, **recognized, task=task)

    @torch.no_grad()
    def act(self, frame: ArrayLike, joints: ArrayLike | None = None) -> NDArray[np.float32]:
        """Return the action for a frame, float32 ``[A]`` in [-1, 1].

        Args:
            frame: uint8 ``[H, W, 3]``.
            joints: Readings of the robot's joints at that time ``[J]``, in the unit of the scene's,
                for a policy that reads them (`BGPOConfig.joints`); None for any other.

        Raises:
            ValueError: If the frame has another dtype or shape, no demonstration was given before,
                or joints are missing, not read, or not finite numbers.
        """
        if self._policy is None:
            raise ValueError("the policy has seen no demonstration: show it one with condition()")
        seen = self._frames(frame, "a frame is uint8 [{}]", 3)
        return self._action(seen, *self._readings(joints)).cpu().numpy()

    def _readings(self, joints: ArrayLike | None) -> list[Tensor]:
        """Return the joints, float32 ``[J]``, if the policy reads them, else nothing."""
        if self._joints is None:
            if joints is not None:
                raise ValueError("this policy reads no joints: give it frames alone")
            return []
        readings, size = np.asarray(joints), self._joints.size
        kind = readings.dtype.kind
        if kind not in "fiu" or readings.shape != (size,) or not np.isfinite(readings).all():
            found = "nothing" if joints is None else f"{readings.dtype} {[*readings.shape]}"
            raise ValueError(
                f"this policy reads {size} joints, finite numbers, beside the frame, got {found}: "
                "act(frame, joints)"
            )
        if self._joints.far(readings):
            warnings.warn(
                "joints are farther from the scene's center than its unit allows: in another unit?",
                stacklevel=4,  # of the call before no_grad's
            )
        return [torch.tensor(readings, dtype=torch.float32)]

    def _action(self, frame: Tensor, joints: Tensor | None = None) -> Tensor:
        """Return the action for a frame and joints, on the device of the policy."""
        assert self._policy is not None
        seen = {"pixels": frame} if joints is None else {"pixels": frame, "joints": joints}
        state = self._observe(TensorDict(seen))[self.config.algorithm.observed]
        return self._policy.act(state.to(self.algorithm.device))

    def preprocess(
        self,
        frames: ArrayLike,
        *,
        color: Literal["rgb", "bgr"],
        crop: tuple[int, int, int, int] | None = None,
    ) -> NDArray[np.uint8]:
        """Return frames of a camera or film as `condition` and `act` take them.

        Args:
            frames: A frame uint8 ``[H', W', 3]``, or several ``[T, H', W', 3]``.
            color: Order of the channels; OpenCV's is ``"bgr"``.
            crop: Top, left, height and width (pixels) of what to keep, the same as of the frames
                that the encoders were trained on; None keeps all.

        Raises:
            ValueError: If frames have another dtype or shape, there is no such order, or the crop
                exceeds the frames.
        """
        array = np.asarray(frames)
        if color not in ("rgb", "bgr"):
            raise ValueError(f"color is {color!r}: choose 'rgb' or, for OpenCV, 'bgr'")
        if array.dtype != np.uint8 or array.ndim not in (3, 4) or array.shape[-1] != 3:
            raise ValueError(f"frames are uint8 [..., H, W, 3], got {array.dtype} {[*array.shape]}")
        if crop is not None:
            top, left, height, width = crop
            inside = top + height <= array.shape[-3] and left + width <= array.shape[-2]
            if not inside or min(top, left) < 0 or min(height, width) < 1:
                raise ValueError(f"crop {crop} exceeds frames of {[*array.shape[-3:-1]]}")
            array = array[..., top : top + height, left : left + width, :]
        array = array[..., ::-1] if color == "bgr" else array
        several = array if array.ndim == 4 else array[None]
        resized = resize_frames(several, self.encoders.frame_network.frame_shape)
        return resized if array.ndim == 4 else resized[0]

    @torch.no_grad()
    def export(self, path: str | Path) -> None:
        """Write the policy, as conditioned, as a program of ``torch.export`` or as an ONNX model.

        It maps a frame uint8 ``[H, W, 3]`` to an action float32 ``[A]`` in [-1, 1], with frame
        encoder, clipping and context inside: ``torch.export.load(path).module()(frame)``, or
        ``onnxruntime.InferenceSession(path).run(None, {"frame": frame})``. A policy that reads
        joints takes them float32 ``[J]`` after the frame, as ``"joints"``. It needs no part of this
        package. Before it is written, its actions are compared with those of `act` on frames of
        noise.

        Args:
            path: File ending in ``.pt2``, or in ``.onnx`` with the extra ``onnx``; an existing one
                is replaced.

        Raises:
            ValueError: If no demonstration was given before, or the file has another ending.
            ImportError: If a package of the extra is missing.
            RuntimeError: If the program acts otherwise; nothing is written.
            OSError: If the file cannot be written.
        """
        path = Path(path)
        if path.suffix not in (".pt2", ".onnx"):
            raise ValueError(
                f"{path} is to hold a program of torch.export or an ONNX model: end its name in "
                ".pt2 or .onnx"
            )
        if self._policy is None:
            raise ValueError("the policy has seen no demonstration: show it one with condition()")
        if path.suffix == ".onnx":
            _check_onnx()
        shape = (*self.encoders.frame_network.frame_shape, 3)
        noise = torch.Generator().manual_seed(0)
        frames = torch.randint(256, (8, *shape), generator=noise, dtype=torch.uint8)
        inputs: list[tuple[Tensor, ...]] = [(frame,) for frame in frames]
        if self._joints is not None:
            size, center, scale = self._joints.size, self._joints.center, self._joints.scale
            drawn = torch.randn(8, size, generator=noise) * torch.tensor(scale)
            inputs = [*zip(frames, drawn + torch.tensor(center), strict=True)]
        exact = path.suffix == ".pt2"

        def action(frame: Tensor, *joints: Tensor) -> Tensor:
            # An exported program takes frames of floats, and acts wrongly; a bitwise operation
            # refuses them. ONNX refuses them itself.
            return self._action(frame.bitwise_and(255) if exact else frame, *joints)

        # Traced with the weights of today, which may decide what is computed at all.
        traced = make_fx(action)(*inputs[0])
        program = torch.export.export(traced, inputs[0])
        scene = find_scene(self.config.scene)
        about = json.dumps({"scene": scene.identity, "rate": scene.rate, "tasks": [*self.tasks]})
        if path.suffix == ".onnx":
            content = _onnx_model(program, about)
            made = _onnx_actions(content)
        else:
            content, made = None, program.module()
        for seen in inputs:
            expected = torch.from_numpy(self.act(*seen))
            if not torch.allclose(made(*seen), expected, rtol=0, atol=1e-5):
                raise RuntimeError("the exported program acts otherwise than the policy")
        make_folder(path.parent)
        if content is not None:
            write_whole(path, content)
        else:
            torch.export.save(program, path, extra_files={"bgpo_trl.json": about})

    def _frames(self, frames: ArrayLike, wanted: str, ndim: int) -> Tensor:
        array = np.asarray(frames)
        shape, expected = array.shape, (*self.encoders.frame_network.frame_shape, 3)
        if (
            array.dtype != np.uint8
            or array.ndim != ndim
            or shape[-3:] != expected
            or not array.size
        ):
            wanted = wanted.format(", ".join(map(str, expected)))
            raise ValueError(f"{wanted}, got {array.dtype} {list(shape)}")
        # Copied, since the array may be read-only.
        return torch.tensor(np.ascontiguousarray(array))


def _check_onnx() -> None:
    """Raise ``ImportError`` if a package that ONNX needs is missing."""
    names = ("onnx", "onnxscript", "onnxruntime")
    missing = [name for name in names if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(
            f"ONNX needs {', '.join(missing)}: pip install 'bgpo_trl[onnx]', or export to a file "
            "ending in .pt2"
        )


def _onnx_model(program: torch.export.ExportedProgram, about: str) -> bytes:
    """Return a program as an ONNX model, with ``about`` as its metadata ``bgpo_trl.json``."""
    logs = [logging.getLogger(name) for name in ("onnxscript", "torch.onnx")]
    levels = [log.level for log in logs]
    try:
        for log in logs:
            log.setLevel(logging.ERROR)  # They report what they leave as it is.
        with warnings.catch_warnings(action="ignore", category=FutureWarning):
            made = torch.onnx.export(
                program,
                dynamo=True,
                verbose=False,
                input_names=["frame", "joints"][: len(program.graph_signature.user_inputs)],
                output_names=["action"],
            )
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)
    assert made is not None
    model: Any = made.model_proto
    model.metadata_props.add(key="bgpo_trl.json", value=about)
    return model.SerializeToString()


def _onnx_actions(model: bytes) -> Callable[..., Tensor]:
    """Return what maps a frame, and joints, to the action of an ONNX model, by onnxruntime."""
    runtime: Any = importlib.import_module("onnxruntime")
    session = runtime.InferenceSession(model, providers=["CPUExecutionProvider"])

    def act(*seen: Tensor) -> Tensor:
        named = zip(("frame", "joints"), (entry.numpy() for entry in seen), strict=False)
        return torch.from_numpy(session.run(None, dict(named))[0])

    return act


def load_run(
    path: str | Path,
    *,
    seed: int | None = None,
    make: Callable[..., Algorithm] | None = None,
) -> TrainedPolicy:
    """Load the policy of a run, finished or not, from its last checkpoint.

    Args:
        path: The run's directory, which is only read.
        seed: One of the run's seeds; None: the first.
        make: Constructor of the algorithm, as for `Trainer`, if it is not in `ALGORITHMS`.

    Raises:
        ValueError: If the run, its checkpoint, seed, algorithm, tasks, encoders or demonstrations
            cannot be found, or if it learned from the ground truth instead of frames.

    Examples:
        >>> import bgpo_trl
        >>> bgpo_trl.load_run("no-run")
        Traceback (most recent call last):
        ...
        ValueError: no-run holds no run: there is no config.json
    """
    run = load_all_seeds(path, make=make)
    seeds = run.config.seeds
    if run.config.algorithm.state != "latent":
        raise ValueError(f"{path} learned from the ground truth: only runs from frames can watch")
    if seed is not None and seed not in seeds:
        raise ValueError(f"{path} has no seed {seed!r}: choose one of {', '.join(map(str, seeds))}")
    return TrainedPolicy(run, seeds[0] if seed is None else seed)


def load_all_seeds(path: str | Path, *, make: Callable[..., Algorithm] | None = None) -> LoadedRun:
    """Load the algorithm of all seeds of a run, finished or not, from its last checkpoint.

    Arguments and errors are those of `load_run`, but runs on the ground truth are taken too, if
    encoders embedded their demonstrations.
    """
    path = Path(path)
    config, digests = read_config(path / "config.json")
    if digests.encoders is None:
        raise ValueError(
            f"{path} was trained without encoders, of which its demonstrations are unknown: give "
            "its Trainer encoders"
        )
    make = entry(config.name).make if make is None else make
    encoders, bank = load_inputs(path, config.tasks, digests, config.scene)
    stored = read_json(path / "config.json")
    compared = differing_settings(stored, settings_of(config, digests))
    if absent := [name for name, found, _ in compared if found == "absent"]:
        warnings.warn(
            f"{path} was made before there was a setting {', '.join(absent)}: today's default is "
            "used; if the policy does worse than it did, use the version of the run",
            stacklevel=3,
        )
    # Compared before anything is made of the sizes in the settings, which may not be the run's.
    saved = read_checkpoint(path, stored, mmap=True, newest=True)
    with fitting_checkpoint(path):
        state, episodes = saved["algorithm"], saved["world"]["source"]["episode"].tolist()
        return LoadedRun.restore(make, config, state, encoders, bank, episodes)
