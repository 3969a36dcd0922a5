"""`DeviceArray`: a torch tensor that answers to numpy's functions, so that one code traces on both.

Rays on a CPU are numpy. On a GPU the same functions get `DeviceArray`s, which numpy hands on
to torch (NEP 13 and 18). Nothing is read back and all shapes are known beforehand, so that a view
may be recorded as one graph: rows that a mask chooses are all rows, and what is done with those
that it leaves out is dropped where it would be stored (`MaskedRows`).
"""

import copy
import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray
from torch import Tensor

from storage.digests import sha256_hex

_TYPES = {
    np.dtype(np.float32): torch.float32,
    np.dtype(np.float64): torch.float64,
    np.dtype(np.int32): torch.int32,
    np.dtype(np.int64): torch.int64,
    np.dtype(np.bool_): torch.bool,
}


class DevicePlace:
    """A device, and the arrays of the host that it holds: each is copied there once."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._held: dict[tuple[object, ...], Tensor] = {}

    def tensor(self, array: NDArray) -> Tensor:
        """Return an array of the host; equal ones share a tensor, which lives as this does."""
        key = (array.dtype.str, array.shape, sha256_hex(array.tobytes()))
        if key not in self._held:
            copy = np.array(array, dtype=None if array.dtype in _TYPES else np.int64)
            self._held[key] = torch.from_numpy(copy).to(self.device)
        return self._held[key]

    def copy_here(self, holder: Any, but: tuple[str, ...] = ()) -> Any:
        """Return a copy of an object whose arrays, and those of its records, are here.

        Args:
            holder: not changed.
            but: names of what stays on the host.
        """
        moved = copy.copy(holder)
        for name, each in vars(holder).items():
            if name not in but and (isinstance(each, np.ndarray) or is_dataclass(each)):
                new = self.array(each) if isinstance(each, np.ndarray) else self.copy_here(each)
                object.__setattr__(moved, name, new)  # of a frozen record too
        return moved

    def array(self, array: NDArray) -> Any:
        """Return a `DeviceArray` of an array of the host, held by nothing else."""
        return DeviceArray(torch.tensor(array, device=self.device), self)


class MaskedRows:
    """Rows that a mask chooses: all of them, of which those that it leaves out do not count."""

    def __init__(self, mask: Tensor) -> None:
        self.mask = mask

    def __len__(self) -> int:
        return len(self.mask)

    def __getitem__(self, among: "MaskedRows") -> "MaskedRows":
        return MaskedRows(self.mask & among.mask)

    def zero_others(self, values: "DeviceArray") -> "DeviceArray":
        """Return the values [..., A] of all rows, 0 for those that do not count."""
        zero = values.tensor.new_zeros(())
        return DeviceArray(torch.where(self.mask, values.tensor, zero), values.place)


def _method(operation: Callable[..., Tensor]) -> Any:
    """Return a method that does what a function of torch does, which takes `axis` for `dim`."""
    return lambda self, *inputs, **named: self._like(operation(self.tensor, *inputs, **named))


class DeviceArray(NDArrayOperatorsMixin):
    """A tensor in the place of a numpy array; its methods are those of numpy's that rays need."""

    def __init__(self, tensor: Tensor, place: DevicePlace) -> None:
        self.tensor = tensor
        self.place = place

    shape = property(lambda self: tuple(self.tensor.shape))
    ndim = property(lambda self: self.tensor.ndim)
    T = property(lambda self: self._like(self.tensor.movedim(-1, 0)))

    def __len__(self) -> int:
        return len(self.tensor)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **named: Any) -> Any:
        operation = _UFUNCS.get(ufunc.__name__, getattr(torch, ufunc.__name__, None))
        if method != "__call__" or operation is None:
            return NotImplemented
        operands = _operand(inputs, self.place)
        if "dtype" in named:
            operands = [each.to(_TYPES[np.dtype(named["dtype"])]) for each in operands]
        result = operation(*operands)
        target = named.get("out", (None,))[0]
        if target is None:
            return self._like(result)
        target.tensor = result.to(target.tensor.dtype)
        return target

    def __array_function__(self, function: Any, types: Any, inputs: Any, named: Any) -> Any:
        operation = _FUNCTIONS.get(function.__name__, getattr(torch, function.__name__, None))
        if operation is None:
            return NotImplemented
        result = operation(*_operand(inputs, self.place), **named)
        return self._like(result) if isinstance(result, Tensor) else result

    def __getitem__(self, key: Any) -> "DeviceArray":
        if isinstance(key, slice) and key.step == -1:
            return self._like(self.tensor.flip(0))
        return self._like(self.tensor[self._index(key)[0]])

    def __setitem__(self, key: Any, values: Any) -> None:
        index, mask = self._index(key)
        values = _operand(values, self.place)
        if mask is not None:
            values = torch.where(mask, values, self.tensor[index])
        self.tensor[index] = values

    def _index(self, key: Any) -> tuple[Any, Tensor | None]:
        """Return the index for torch, and which of its rows count."""
        keys: list[Any] = []
        mask = None
        parts = key if isinstance(key, tuple) else (key,)
        gathers = any(isinstance(each, DeviceArray | np.ndarray) for each in parts)
        for each in parts:
            if isinstance(each, MaskedRows):
                mask = each.mask
                keys.append(self.place.tensor(np.arange(len(each))) if gathers else slice(None))
            elif isinstance(each, DeviceArray | np.ndarray):
                keys.append(_operand(each, self.place))
            else:
                keys.append(each)
        return tuple(keys), mask

    def _like(self, tensor: Tensor) -> "DeviceArray":
        return DeviceArray(tensor, self.place)

    def astype(self, dtype: Any) -> "DeviceArray":
        return self._like(self.tensor.to(_TYPES[np.dtype(dtype)]))

    def copy(self) -> "DeviceArray":
        return self._like(self.tensor.clone(memory_format=torch.contiguous_format))

    def cross(self, other: "DeviceArray") -> "DeviceArray":
        return self._like(torch.linalg.cross(self.tensor, other.tensor, dim=0))

    def reshape(self, *shape: Any) -> "DeviceArray":
        return self._like(self.tensor.reshape(*shape))

    swapaxes = _method(torch.swapaxes)
    ravel = _method(torch.flatten)
    sum = _method(torch.sum)
    mean = _method(torch.mean)
    max = _method(torch.amax)
    argmax = _method(torch.argmax)
    clip = _method(torch.clamp)
    all = _method(torch.all)

    def any(self) -> bool:
        """Return True, without asking the device: some may be."""
        return True


def _operand(value: Any, place: DevicePlace) -> Any:
    """Return a tensor, a number of Python, or a list of these."""
    if isinstance(value, list | tuple):
        return [_operand(each, place) for each in value]
    if isinstance(value, DeviceArray):
        return value.tensor
    if isinstance(value, np.ndarray) and value.ndim:
        return place.tensor(value)
    return value.item() if isinstance(value, np.ndarray | np.generic) else value


def _limit(bound: str, a: Any, b: Any) -> Tensor:
    """Return a maximum or minimum of tensors or a number."""
    tensor, limit = (a, b) if isinstance(a, Tensor) else (b, a)
    return tensor.clamp(**{bound: limit})


_UFUNCS: dict[str, Callable] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "floor_divide": operator.floordiv,
    "remainder": operator.mod,
    "power": operator.pow,
    "negative": operator.neg,
    "matmul": operator.matmul,
    "less": operator.lt,
    "less_equal": operator.le,
    "greater": operator.gt,
    "greater_equal": operator.ge,
    "equal": operator.eq,
    "bitwise_and": operator.and_,
    "bitwise_or": operator.or_,
    "invert": operator.invert,
    "maximum": partial(_limit, "min"),
    "minimum": partial(_limit, "max"),
    "radians": torch.deg2rad,
}
"""Operations that torch has not under numpy's name, or not of numbers."""


def _take(array: Tensor, index: Tensor, axis: int = 0) -> Tensor:
    return array[(slice(None),) * (axis % array.ndim) + (index,)]


def _interp(x: Tensor, known: Tensor, values: Tensor) -> Tensor:
    right = torch.searchsorted(known, x.contiguous()).clamp(1, len(known) - 1)
    share = ((x - known[right - 1]) / (known[right] - known[right - 1])).clamp(0, 1)
    return values[right - 1] + share * (values[right] - values[right - 1])


_FUNCTIONS: dict[str, Callable] = {
    "flatnonzero": lambda mask: MaskedRows(mask.flatten() != 0),
    "interp": _interp,
    # the places of all elements: those that the mask leaves out may be given no weight
    "nonzero": lambda mask: tuple(each.ravel() for each in np.indices(mask.shape)),
    "take": _take,
    "take_along_axis": torch.take_along_dim,
    "tile": lambda a, count: a.repeat(count),
    "zeros_like": lambda a, shape=None: a.new_zeros(shape or a.shape),
}
"""Functions that torch has not under numpy's name, or not alike."""


class Replayed:
    """A function of tensors, which a GPU runs once, records as a graph, and repeats from then on.

    A view of `hits` is four thousand small kernels; submitting them one by one takes longer than
    they.
    It may read nothing back and use no array of the host that its first run has not brought to the
    GPU. What it returns is overwritten by the next call.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]) -> None:
        self._function = function
        self._calls = 0
        self._inputs: tuple[Tensor, ...] = ()
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the function's tensors, for tensors of always the same shapes on one GPU."""
        self._calls += 1
        if self._calls == 1:
            return self._function(*inputs)
        if self._graph is None:
            self._inputs = tuple(each.clone() for each in inputs)
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                self._result = self._function(*self._inputs)
            self._graph = graph
        for held, new in zip(self._inputs, inputs, strict=True):
            held.copy_(new)
        self._graph.replay()
        return self._result


@contextmanager
def aside(device: torch.device | None) -> Iterator[Callable[[], None]]:
    """Let a graph that is being recorded do the block beside what follows it; else, in order.

    Arrays that the block reads have to live until the function that it yields was called, from
    which on its results may be read.
    """
    if device is None or device.type != "cuda" or not torch.cuda.is_current_stream_capturing():
        yield lambda: None
        return
    main = torch.cuda.current_stream(device)
    branch = torch.cuda.Stream(device)
    branch.wait_stream(main)
    with torch.cuda.stream(branch):
        yield lambda: main.wait_stream(branch)
