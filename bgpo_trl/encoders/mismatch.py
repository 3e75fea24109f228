"""In what demonstrations seem unlike those that encoders were trained on: `mismatch`."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from bgpo_trl.encoders.probes import OWN_TASK
from bgpo_trl.encoders.representation import valid_frames, valid_steps
from bgpo_trl.modules.frame_network import FrameNetwork
from bgpo_trl.modules.vae import VAE

_ALIKE = 0.5  # correlation of actions from which a comparison means something
_OFF = 0.25  # mean difference of recorded from inferred actions that says something
_COMPARED = 256  # frames that are compared, about


@torch.no_grad()
def mismatch(
    network: FrameNetwork, dataset: TensorDictBase, inferred: Tensor | None, embedding: Tensor
) -> str:
    """Return in what demonstrations seem unlike those that encoders were trained on, or "".

    Recorded actions are compared with inferred ones, and frames with their reconstructions, each
    also after what people get wrong: a step earlier or later, components exchanged, a mirrored
    camera and the like. Demonstrations should be nearest to one of their own task. What leaves no
    trace is not seen: tasks exchanged as a whole, or ends cut off.

    Args:
        network: The frame encoder.
        dataset: Reads ``pixels``, ``length``, ``task`` and, if it is there, ``action``.
        inferred: Actions of the inverse model for its frames ``[N, T - 1, A]``, or None.
        embedding: Embeddings of the demonstrations, ``[N, 32]``.
    """
    length, recorded = dataset["length"], dataset.get("action", None)
    every = max(1, int(length.sum()) // _COMPARED)
    shown = {key: dataset[key][::every] for key in ("pixels", "length")}
    some = TensorDict(shown, [len(shown["length"])])
    doubt = doubt_frames(network, valid_frames(some)[:_COMPARED])
    # From frames that are wrong, wrong actions are inferred.
    if not doubt and inferred is not None and recorded is not None:
        doubt = _doubt_actions(recorded, inferred, length)
    return doubt or _doubt_tasks(embedding, dataset["task"])


def _doubt_tasks(embedding: Tensor, task: Tensor) -> str:
    """Return that tasks ``[N]`` of nearest embeddings ``[N, 32]`` differ too often, or ""."""
    some = torch.arange(len(task))[:: len(task) // 2_000 + 1]
    embedding, task = embedding[some], task[some]
    nearest = torch.cdist(embedding, embedding).fill_diagonal_(torch.inf).argmin(1)
    own = float((task[nearest] == task).float().mean())
    # Of few, none of the same task need be near.
    if own >= OWN_TASK or len(task) < 8 * len(task.unique()):
        return ""
    return (
        f"{own:.0%} of the demonstrations are nearest to one of their own task: are tasks mixed "
        "up, or do the encoders not tell them apart?"
    )


def _doubt_actions(recorded: Tensor, inferred: Tensor, length: Tensor) -> str:
    """Return in what recorded actions ``[N, T - 1, A]`` differ from inferred ones, or ""."""

    def correlation(one: Tensor, other: Tensor) -> float:
        return float((one * other).sum() / (one.norm() * other.norm()).clamp_min(1e-9))

    moves = valid_steps(length - 1, recorded.shape[1])
    later = moves[:, 1:]
    now = correlation(recorded[moves], inferred[moves])
    late = correlation(recorded[:, 1:][later], inferred[:, :-1][later])
    early = correlation(recorded[:, :-1][later], inferred[:, 1:][later])
    if max(late, early) > max(now + 0.1, _ALIKE):
        when = "late" if late > early else "early"
        return (
            f"recorded actions seem to be a step too {when} (correlation with what frames show: "
            f"{now:.2f}, shifted {max(late, early):.2f}): action t leads from frame t to t + 1"
        )
    given, own = recorded[moves], inferred[moves]
    alike = torch.tensor(
        [[correlation(one, other) for other in own.unbind(-1)] for one in given.unbind(-1)]
    )
    strongest = alike.abs().argmax(1).tolist()
    for component, other in enumerate(strongest):
        found = float(alike[component, other])
        if component != other and abs(found) > max(_ALIKE, 2 * abs(alike[component, component])):
            return (
                f"component {component} (from 0) of recorded actions moves what component {other} "
                f"moved in the encoders' demonstrations (correlation {found:.2f}): exchange them"
            )
        if component == other and found < -_ALIKE:
            return (
                f"component {component} (from 0) of recorded actions has the opposite sign of what "
                f"frames show (correlation {found:.2f}): turn it round"
            )
    if now < _ALIKE:
        return (
            f"recorded actions have little to do with what frames show (correlation {now:.2f}): "
            "give what the robot was told at each step, as in the encoders' demonstrations"
        )
    for component, offset in enumerate((given - own).mean(0).tolist()):
        if abs(offset) > _OFF:
            return (
                f"component {component} (from 0) of recorded actions is {offset:+.2f} off what "
                "frames show, on average: scale it as in the encoders' demonstrations"
            )
    scale = float((given * own).sum() / own.square().sum().clamp_min(1e-9))
    if not 0.75 < scale < 1.33:
        return (
            f"recorded actions are {scale:.2f} times as large as frames suggest: scale them as "
            "those of the encoders' demonstrations, and give as many frames a second"
        )
    return ""


def _moved(rows: int, columns: int) -> Callable[[Tensor], Tensor]:
    """Return what moves frames down and to the right, and repeats the edge."""

    def move(frames: Tensor) -> Tensor:
        for dim, by in ((1, rows), (2, columns)):
            places = torch.arange(frames.shape[dim], device=frames.device) - by
            frames = frames.index_select(dim, places.clamp(0, frames.shape[dim] - 1))
        return frames

    return move


def _brighter(factor: float) -> Callable[[Tensor], Tensor]:
    return lambda frames: (factor * frames).clamp(0, 255).to(torch.uint8)


_RED = "give them red first (OpenCV's are blue first, frame[..., ::-1] turns them)"
_CAMERA = "place and set the camera as for the encoders' demonstrations, or train encoders anew"
# By what frames would fit better: the change that makes them so, and the remedy.
_CHANGES: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "with red and blue exchanged": (lambda frames: frames.flip(-1), _RED),
    "mirrored": (lambda frames: frames.flip(2), _CAMERA),
    "upside down": (lambda frames: frames.flip(1), _CAMERA),
    "turned by 180 degrees": (lambda frames: frames.flip(1, 2), _CAMERA),
    "with rows and columns exchanged": (lambda frames: frames.transpose(1, 2), _CAMERA),
    **{f"{k} times as bright": (_brighter(k), _CAMERA) for k in (0.6, 0.7, 0.85, 1.2, 1.4, 1.7)},
    **{
        f"{by} pixel{'s' * (by > 1)} farther {where}": (_moved(by * rows, by * columns), _CAMERA)
        for by in (1, 2, 3)
        for where, rows, columns in (
            ("up", -1, 0),
            ("down", 1, 0),
            ("left", 0, -1),
            ("right", 0, 1),
        )
    },
}


@torch.no_grad()
def doubt_frames(network: FrameNetwork, frames: Tensor) -> str:
    """Return what to do if frames uint8 ``[N, H, W, 3]`` seem taken otherwise than in training.

    A VAE then reconstructs them better once they are changed: colors exchanged, mirrored, turned,
    brighter, darker, or moved. Without a decoder, other networks cannot tell: the result is "".
    """
    if not isinstance(network, VAE):
        return ""
    frames = frames.to(network.latent_mean.device)

    def error(some: Tensor) -> float:
        return float((some / 255 - network.decode(network.encode(some)[0])).square().mean())

    changed = {how: change(frames) for how, (change, _) in _CHANGES.items()}
    errors = {how: error(some) for how, some in changed.items() if some.shape == frames.shape}
    best = min(errors, key=errors.__getitem__)
    usual = network.decode(network.latent_mean.unsqueeze(0))
    apart = float((changed[best] / 255 - usual).square().mean())
    # A network that reconstructs neither tells nothing, unless one is reconstructed far better; in
    # doubt, frames are as they should be.
    unchanged = error(frames)
    if errors[best] >= min(0.9 * unchanged, max(0.5 * apart, 0.6 * unchanged)):
        return ""
    return f"frames fit the encoders better {best}: {_CHANGES[best][1]}"
