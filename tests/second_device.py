"""A second device on a machine that has none: tensors on `meta` that compute on the CPU.

As on a GPU, an operation on tensors of two devices fails, and so does drawing there with a
generator of the CPU. Indices, tensors without dimensions and copies may come from elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

from bgpo_trl import training

DEVICE = torch.device("meta")
_aten = torch.ops.aten
_COPIES = (_aten.copy_.default, _aten._to_copy.default)
_INDEXING = (
    _aten.index.Tensor,
    _aten.index_put.default,
    _aten.index_put_.default,
    _aten._index_put_impl_.default,
)


class RemoteTensor(Tensor):
    """A tensor of the second device; ``local`` is the one on the CPU that holds its numbers."""

    local: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore

    @staticmethod
    def __new__(cls, local: Tensor) -> RemoteTensor:
        """Wrap a tensor of the CPU."""
        wrapper = torch.Tensor._make_wrapper_subclass(  # pyright: ignore
            cls,
            local.shape,
            strides=local.stride(),
            storage_offset=local.storage_offset(),
            dtype=local.dtype,
            device=DEVICE,
        )
        wrapper.local = local
        return wrapper

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Compute on the second device."""
        return _compute(func, args, kwargs or {})


def _compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    remote = [tensor for tensor in tensors if isinstance(tensor, RemoteTensor)]
    local = [tensor for tensor in tensors if not isinstance(tensor, RemoteTensor) and tensor.ndim]
    if func in _INDEXING and isinstance(args[0], RemoteTensor):
        local = [tensor for tensor in local if tensor.dtype not in (torch.int64, torch.bool)]
    if remote and local and func not in _COPIES:
        raise RuntimeError(f"{func} of tensors on two devices")
    device = kwargs.get("device")
    stays = bool(remote) if device is None else torch.device(device) == DEVICE
    if stays and kwargs.get("generator") is not None:
        raise RuntimeError(f"{func} with a generator of another device")
    of_cpu = kwargs if device is None else {**kwargs, "device": torch.device("cpu")}
    local_args, local_kwargs = tree_map_only(RemoteTensor, lambda x: x.local, (args, of_cpu))
    result = func(*local_args, **local_kwargs)
    if func is _aten.copy_.default:
        return args[0]
    if not stays:
        return result
    result = tree_map_only(Tensor, RemoteTensor, result)
    return return_and_correct_aliasing(func, args, kwargs, result) if remote else result


class _Operations(TorchDispatchMode):
    """Operations that make tensors of the second device."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        device = kwargs.get("device")
        if device is not None and torch.device(device) == DEVICE:
            return _compute(func, args, kwargs)
        return func(*args, **kwargs)


class _Constants(TorchFunctionMode):
    """`torch.tensor` and `torch.as_tensor`, which are no such operations."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        device = kwargs.get("device")
        made_there = device is not None and torch.device(device) == DEVICE
        if func in (torch.tensor, torch.as_tensor) and made_there:
            return func(*args, **{**kwargs, "device": "cpu"}).to(DEVICE)
        return func(*args, **kwargs)


def _enter() -> None:
    _Operations().__enter__()
    _Constants().__enter__()


def _save_local(save: Any, path: Any, state: Any) -> None:
    save(path, tree_map_only(RemoteTensor, lambda x: x.local, state))


def _autocast(of_torch: Any, device_type: str, *args: Any, **kwargs: Any) -> Any:
    return of_torch("cpu" if device_type == DEVICE.type else device_type, *args, **kwargs)


@contextmanager
def second_device() -> Iterator[torch.device]:
    """Make `DEVICE` usable, in the thread of a trainer's updates too."""
    with ExitStack() as stack:
        stack.enter_context(_Operations())
        stack.enter_context(_Constants())
        pool = partial(ThreadPoolExecutor, initializer=_enter)
        stack.enter_context(patch.object(training, "ThreadPoolExecutor", pool))
        save = partial(_save_local, training.save_checkpoint)
        stack.enter_context(patch.object(training, "save_checkpoint", save))
        supported = "torch.optim.optimizer._get_fused_kernels_supported_devices"
        stack.enter_context(patch(supported, lambda: ["cpu", DEVICE.type]))
        autocast = partial(_autocast, torch.autocast)
        stack.enter_context(patch.object(torch, "autocast", autocast))
        yield DEVICE
