"""What a card would be told to do: every kernel of a block of code, with what it reads and writes.

On the card that is not there (infra.fake_card). Views cost nothing; every other operation is one
kernel, but those over lists of tensors, which are as many as their elements need.
"""

import math
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal
from unittest import mock

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from infra.bench.roofline.cards import FOREACH_ELEMENTS

Part = tuple[str, int]
"""Name of a part of the computation, and which visit of it; ("", 0) is what belongs to none."""

Kind = Literal["product", "convolution", "attention", "cast", "pointwise"]
"""`pointwise` is all that is limited by memory: elementwise, reductions, norms, copies."""

ALIGNMENT = 512
"""Bytes to which torch's allocator rounds every block up."""

_FREE = {
    "aten::detach", "aten::_unsafe_view", "aten::empty", "aten::expand", "aten::alias",
    "aten::empty_like", "aten::empty_strided", "aten::new_empty", "aten::new_empty_strided",
    "aten::lift_fresh", "aten::resize_", "aten::_reshape_alias", "aten::set_",
}  # fmt: skip
_WAITS = {
    "aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::_unique2",
    "aten::unique_dim", "aten::equal",
}  # fmt: skip
_ATTENTION = ("flash_attention", "efficient_attention", "_varlen_attn", "cudnn_attention")


@dataclass(frozen=True, kw_only=True)
class Access:
    """One tensor that a kernel reads or writes."""

    storage: int
    """Number of the memory that it lies in."""
    size: int
    """Bytes that are touched."""
    layout: tuple[Any, ...]
    """Type, shape, strides and offset: two equal ones on one storage are the same tensor."""


@dataclass(frozen=True, kw_only=True)
class Kernel:
    """One call of a kernel, or one operation over lists that takes several."""

    name: str
    """torch's name of the operation."""
    kind: Kind
    """What limits it."""
    launches: int
    """How many kernels it is."""
    reads: tuple[Access, ...]
    """Its inputs."""
    writes: tuple[Access, ...]
    """Its outputs."""
    flops: int
    """Counted as torch's FlopCounterMode does."""
    product_type: str
    """What it multiplies in: `bfloat16`, `float32`; empty where it is no product."""
    elements: int
    """Of its largest tensor: kernels of one number can be one loop."""
    part: Part
    """Which part of the computation asked for it."""
    is_backward: bool
    """Whether it is a part's way back."""

    @property
    def num_bytes(self) -> int:
        """Bytes from and to memory."""
        return sum(access.size for access in (*self.reads, *self.writes))


@dataclass(kw_only=True)
class Traced:
    """What was seen."""

    kernels: list[Kernel] = field(default_factory=list)
    """In the order of their calls."""
    born: dict[int, tuple[int, int]] = field(default_factory=dict)
    """By storage: number of kernels before it was taken, and its bytes."""
    died: dict[int, int] = field(default_factory=dict)
    """By storage: number of kernels before it was given back; of those that were."""
    waits: int = 0
    """How often the host waited for a number from the card."""
    window_waits: int = 0
    """How often it waits to learn what a window of such steps did."""


class Tracer(TorchDispatchMode):
    """Notes what is asked of the card while it is entered."""

    def __init__(self) -> None:
        super().__init__()
        self.traced = Traced()
        self._seen: dict[int, int] = {}
        self._next = 0
        self._spans: list[tuple[int, int, Part]] = []
        self._open: list[Part] = []
        self._visits: dict[str, int] = {}
        self._quiet = False

    def begin_again(self) -> None:
        """Forget the kernels and keep what memory is held, as if all of it had been taken now."""
        held = {number: self.traced.born[number] for number in self._seen.values()}
        born = {number: (0, size) for number, (_, size) in held.items()}
        self.traced = Traced(born=born)
        self._spans, self._visits = [], {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Have what is done in a block, and its way back, belong to a part."""
        self._visits[name] = visit = self._visits.get(name, 0) + 1
        first = _sequence()
        self._open.append((name, visit))
        try:
            yield
        finally:
            self._spans.append((first, _sequence(), self._open.pop()))

    @contextmanager
    def counting(self) -> Iterator["Tracer"]:
        """Enter, with a list of numbers from the card counted as one wait and not one for each."""
        numbers = FakeTensor.tolist

        def listed(tensor: FakeTensor) -> Any:
            self.traced.waits += tensor.device.type == "cuda"
            self._quiet, before = True, self._quiet
            try:
                return numbers(tensor)
            finally:
                self._quiet = before

        with mock.patch.object(FakeTensor, "tolist", listed), self:
            yield self

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        inputs, outputs = _tensors((args, kwargs)), _tensors(out)
        name: str = func._schema.name
        if self._waits(name, inputs, outputs):
            self.traced.waits += 1
        on_card = [tensor for tensor in outputs if tensor.device.type == "cuda"]
        written = on_card or _written(func, args)
        writes = tuple(self._access(tensor) for tensor in written)
        if writes and not (func.is_view or name in _FREE or name.startswith("prim")):
            self._note(func, name, args, kwargs, out, inputs, writes)
        return out

    def _waits(self, name: str, inputs: list[Tensor], outputs: list[Tensor]) -> bool:
        if self._quiet or not any(tensor.device.type == "cuda" for tensor in inputs):
            return False
        copied = name in ("aten::_to_copy", "aten::copy_") and outputs[0].device.type == "cpu"
        return copied or name in _WAITS

    def _note(
        self,
        func: Any,
        name: str,
        args: Any,
        kwargs: Any,
        out: Any,
        inputs: list[Tensor],
        writes: tuple[Access, ...],
    ) -> None:
        read = [tensor for tensor in inputs if tensor.device.type == "cuda"]
        if "_varlen_attn" in name:
            flops = _packed_flops(args, is_backward="backward" in name)
        else:
            counted = flop_registry.get(func._overloadpacket)
            flops = counted(*args, **(kwargs or {}), out_val=out) if counted else 0
        kind = _kind(name, flops)
        floating = next((each for each in read if each.is_floating_point()), None)
        many = _tensors(out) or read
        launches = 1
        if "_foreach_" in name or "_fused_adam" in name or "_fused_sgd" in name:
            listed = [each for each in tree_leaves(args[0]) if isinstance(each, Tensor)]
            launches = math.ceil(sum(each.numel() for each in listed) / FOREACH_ELEMENTS)
        part, is_backward = self._part_now()
        self.traced.kernels.append(
            Kernel(
                name=name,
                kind=kind,
                launches=max(launches, 1),
                reads=tuple(self._access(tensor) for tensor in read),
                writes=writes,
                flops=int(flops),
                product_type=str(floating.dtype).removeprefix("torch.")
                if floating is not None and flops
                else "",
                elements=max((each.numel() for each in (*many, *read)), default=0),
                part=part,
                is_backward=is_backward,
            )
        )

    def _part_now(self) -> tuple[Part, bool]:
        if self._open:
            return self._open[-1], False
        node = torch._C._current_autograd_node()
        if node is None:
            return ("", 0), False
        number = node._sequence_nr()
        inside = [span for span in self._spans if span[0] <= number < span[1]]
        # parts lie within each other: the last to begin is the innermost
        return (max(inside)[2] if inside else ("", 0)), True

    def _access(self, tensor: Tensor) -> Access:
        storage = tensor.untyped_storage()
        key = storage._cdata
        if key not in self._seen:
            self._seen[key] = self._next
            self._next += 1
            size = math.ceil(storage.nbytes() / ALIGNMENT) * ALIGNMENT
            self.traced.born[self._seen[key]] = (len(self.traced.kernels), size)
            weakref.finalize(storage, self._forget, key)
        spread = tensor.numel() * tensor.element_size()
        return Access(
            storage=self._seen[key],
            size=min(spread, storage.nbytes()),
            layout=(tensor.dtype, tuple(tensor.shape), tensor.stride(), tensor.storage_offset()),
        )

    def _forget(self, key: int) -> None:
        self.traced.died[self._seen.pop(key)] = len(self.traced.kernels)


def _sequence() -> int:
    return int(torch._C._autograd._get_sequence_nr())


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


def _written(func: Any, args: Any) -> list[Tensor]:
    """Return what an operation without results on the card writes in place.

    Fused updates write gradients only where they also divide them by a scale, which none does here.
    """
    given = zip(func._schema.arguments, args, strict=False)
    places = [(place, arg) for place, arg in given if place.name != "grads"]
    written = [arg for place, arg in places if place.alias_info and place.alias_info.is_write]
    return [tensor for tensor in _tensors(written) if tensor.device.type == "cuda"]


def _packed_flops(args: Any, *, is_backward: bool) -> int:
    """Return the FLOPs of packed attention, whose sequences are about equally long.

    torch counts the longest for each, since fake tensors hold no lengths.
    """
    query, key, starts = (args[1], args[2], args[7]) if is_backward else (args[0], args[1], args[4])
    products = 10 if is_backward else 4  # as torch counts five and two products of matrices
    pairs = query.shape[0] * key.shape[0] // (len(starts) - 1)
    return int(products * pairs * query.shape[1] * query.shape[2])


def _kind(name: str, flops: int) -> Kind:
    if any(word in name for word in _ATTENTION):
        return "attention"
    if "convolution" in name:
        return "convolution"
    if flops:
        return "product"
    return "cast" if name == "aten::_to_copy" else "pointwise"
