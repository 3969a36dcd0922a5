"""`DeviceArray`: a torch tensor that answers to numpy's functions, so that one code traces on both.

Rays on a CPU are numpy. On a GPU the same functions get `DeviceArray`s, which numpy hands on
to torch (NEP 13 and 18). Nothing is read back and all shapes are known beforehand, so that a view
may be recorded as one graph: rows that a mask chooses are all rows, and what is done with those
that it leaves out is dropped where it would be stored (`MaskedRows`).
"""

import copy
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray
from torch import Tensor

from storage.digests import sha256_hex
from storage.records.environment import Environment

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

    def moved(self, holder: Any, but: tuple[str, ...] = ()) -> Any:
        """Return a copy of an object whose arrays, and those of its records, are here.

        Args:
            holder: not changed.
            but: names of arrays that stay on the host.
        """
        moved = copy.copy(holder)
        for name, each in vars(holder).items():
            if name not in but and isinstance(each, np.ndarray | Environment):
                new = self.array(each) if isinstance(each, np.ndarray) else self.moved(each)
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
        operation = _UFUNCS.get(ufunc.__name__)
        if method != "__call__" or operation is None:
            return NotImplemented
        operands = [_operand(each, self.place) for each in inputs]
        if "dtype" in named:
            operands = [each.to(_TYPES[np.dtype(named["dtype"])]) for each in operands]
        result = operation(*operands)
        target = named.get("out", (None,))[0]
        if target is None:
            return self._like(result)
        where = named.get("where", True)
        if where is not True:
            result = torch.where(where.tensor, result, target.tensor)
        target.tensor = result.to(target.tensor.dtype)
        return target

    def __array_function__(self, function: Any, types: Any, inputs: Any, named: Any) -> Any:
        operation = _FUNCTIONS.get(function)
        if operation is None:
            return NotImplemented
        result = operation(self.place, *inputs, **named)
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
    """Return a tensor, or a number of Python."""
    if isinstance(value, DeviceArray):
        return value.tensor
    if isinstance(value, np.ndarray) and value.ndim:
        return place.tensor(value)
    return value.item() if isinstance(value, np.ndarray | np.generic) else value


def _clamp_or(least: Callable, number: str) -> Callable:
    """Return a maximum or minimum that takes numbers too."""

    def of(a: Any, b: Any) -> Tensor:
        if isinstance(a, Tensor) and isinstance(b, Tensor):
            result: Tensor = least(a, b)
            return result
        tensor, limit = (a, b) if isinstance(a, Tensor) else (b, a)
        return tensor.clamp(**{number: limit})

    return of


_UFUNCS: dict[str, Callable] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "floor_divide": operator.floordiv,
    "remainder": operator.mod,
    "power": operator.pow,
    "negative": operator.neg,
    "positive": operator.pos,
    "matmul": operator.matmul,
    "less": operator.lt,
    "less_equal": operator.le,
    "greater": operator.gt,
    "greater_equal": operator.ge,
    "equal": operator.eq,
    "bitwise_and": operator.and_,
    "bitwise_or": operator.or_,
    "invert": operator.invert,
    "maximum": _clamp_or(torch.maximum, "min"),
    "minimum": _clamp_or(torch.minimum, "max"),
    "absolute": torch.abs,
    "arctan2": torch.atan2,
    "copysign": torch.copysign,
    "cos": torch.cos,
    "floor": torch.floor,
    "hypot": torch.hypot,
    "radians": torch.deg2rad,
    "sin": torch.sin,
    "sqrt": torch.sqrt,
    "square": torch.square,
    "tan": torch.tan,
}


def _all(inputs: Any, place: DevicePlace) -> list[Tensor]:
    return [_operand(each, place) for each in inputs]


def _where(place: DevicePlace, condition: Any, a: Any, b: Any) -> Tensor:
    condition, a, b = _all((condition, a, b), place)
    return torch.where(condition, a, b)


def _take(place: DevicePlace, array: Any, index: Any, axis: int = 0) -> Tensor:
    dim = axis % array.ndim
    return _operand(array, place)[(slice(None),) * dim + (_operand(index, place),)]


def _interp(place: DevicePlace, *inputs: Any) -> Tensor:
    x, known, values = _all(inputs, place)
    right = torch.searchsorted(known, x.contiguous()).clamp(1, len(known) - 1)
    share = ((x - known[right - 1]) / (known[right] - known[right - 1])).clamp(0, 1)
    return values[right - 1] + share * (values[right] - values[right - 1])


def _nonzero(place: DevicePlace, mask: DeviceArray) -> tuple[NDArray, ...]:
    """Return the places of all elements: those that the mask leaves out may be given no weight."""
    return tuple(each.ravel() for each in np.indices(mask.shape))


_FUNCTIONS: dict[Any, Callable] = {
    np.broadcast_to: lambda place, a, shape: a.tensor.expand(shape),
    np.clip: lambda place, a, least, most: a.tensor.clamp(least, most),
    np.concatenate: lambda place, a, axis=0: torch.cat(_all(a, place), dim=axis),
    np.cumsum: lambda place, a, axis: a.tensor.cumsum(dim=axis),
    np.flatnonzero: lambda place, mask: MaskedRows(mask.tensor.flatten() != 0),
    np.full_like: lambda place, a, value: torch.full_like(a.tensor, float(value)),
    np.interp: _interp,
    np.moveaxis: lambda place, a, source, target: a.tensor.movedim(source, target),
    np.nonzero: _nonzero,
    np.ones_like: lambda place, a: torch.ones_like(a.tensor),
    np.searchsorted: lambda place, a, v, side="left": torch.searchsorted(
        *_all((a, v), place), side=side
    ),
    np.stack: lambda place, a, axis=0: torch.stack(_all(a, place), dim=axis),
    np.take: _take,
    np.take_along_axis: lambda place, a, index, axis: a.tensor.gather(axis, index.tensor),
    np.tile: lambda place, a, count: a.tensor.repeat(count),
    np.where: _where,
    np.zeros_like: lambda place, a, shape=None: a.tensor.new_zeros(shape or a.shape),
}
