"""Mixed precision of the network's matrix products, chosen at run time, absent from checkpoints.

The layers of both stages and the head may be rounded. Always float32 are positions and rotary
angles with their sines, the rotation itself, ray directions and their layer, normals and their
octaves, materials, the learned tokens, and a head's last layers, whose rounding would be visible as
banding. These are a hundredth of the work; rounding them too cost 7 dB on a trained network (study
S68).

Weights are rounded once before inference, and not at every use (autocast): equally fast, half the
memory. Training in reduced precision needs float32 weights and therefore uses autocast;
`without_autocast` disables it for operations that are always float32. Autocast rounds every matrix
in a separate kernel, and its gradient in another one: hundreds of launches with little work. So a
layer's weights are rounded together; every number is exactly that of autocast.
"""

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from storage.errors import TrilightError

if TYPE_CHECKING:
    from model.renderformer import RenderFormer


@dataclass(frozen=True, kw_only=True)
class PrecisionChoice:
    """One number format and where it is available."""

    dtype: torch.dtype
    """Type of the weights and activations of the layers and the head."""
    tf32: bool = False
    """True if a GPU may multiply float32 matrices with 10 bits of mantissa."""
    needs_cuda: bool = False
    """True if a CPU has no fast path for it, so that it is refused there."""


PRECISIONS = {
    "float32": PrecisionChoice(dtype=torch.float32),
    "bfloat16": PrecisionChoice(dtype=torch.bfloat16),
    "tf32": PrecisionChoice(dtype=torch.float32, tf32=True, needs_cuda=True),
    "float16": PrecisionChoice(dtype=torch.float16, needs_cuda=True),
}
"""Precisions by name. Studies S67 and S68 have speeds and errors of bfloat16, and errors of
float16; the speed of float16 and all of tf32 were not measured."""


REDUCED = (torch.bfloat16, torch.float16)
"""Types that flash attention computes in."""


def rounded_parts(model: "RenderFormer") -> list[nn.Module]:
    """Return the modules that a precision rounds; the others stay float32."""
    scene = [] if model.encoder is None else [model.encoder.layers]
    return [*scene, model.decoder.layers, *model.decoder.head.rounded_parts]


def set_precision(model: "RenderFormer", name: str) -> "RenderFormer":
    """Round a network for inference, in place, and return it.

    Rounding cannot be undone: to return to float32, open the checkpoint again.

    Raises:
        TrilightError: no such precision, or the network's device does not support it.
    """
    if name not in PRECISIONS:
        raise TrilightError(f"precision {name!r}: expected one of {', '.join(PRECISIONS)}.")
    precision = PRECISIONS[name]
    device = next(model.parameters()).device
    if precision.needs_cuda and device.type != "cuda":
        raise TrilightError(
            f"precision {name}: the network is on {device.type}, which has no fast path for it; "
            "expected a CUDA device. Use bfloat16."
        )
    for part in rounded_parts(model):
        part.to(precision.dtype)
    model.tf32 = precision.tf32
    return model


def without_autocast(device: torch.device) -> AbstractContextManager[None]:
    """Return a context without autocast, in which operations keep the types of their inputs."""
    if device.type == "meta":  # it has no autocast, and operations are only counted there
        return nullcontext()  # torch 2.11 cannot compile a check whether a device has it
    return torch.autocast(device.type, enabled=False)


@contextmanager
def fast_float32_products(device: torch.device, *, enabled: bool) -> Iterator[None]:
    """Let a GPU multiply float32 matrices with 10 bits of mantissa, eight times as fast.

    Used while a network trains in reduced precision: in the backward pass, whose other products
    have 7 bits, and in the pixel network of `hits`. On an H200 float32 there took a sixth of the
    step of `hits-256`.
    """
    if device.type != "cuda" or not enabled:
        yield
        return
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@contextmanager
def tf32(allowed: bool) -> Iterator[None]:
    """Allow or forbid TF32 in CUDA's float32 products and convolutions; no effect on a CPU.

    Torch allows TF32 in convolutions by default, so plain float32 has to be requested too. Within
    autocast, in training, convolutions keep torch's default: a head's last layers are then rounded
    to 10 bits of mantissa, as in the backward pass anyway, and not to 7. Products follow the
    request: rays and materials are not rounded at all.
    """
    convolution = torch.backends.cudnn.conv  # type: ignore[attr-defined]
    switches = (torch.backends.cuda.matmul, convolution)
    before = [switch.fp32_precision for switch in switches]
    try:
        for switch in switches:
            of_training = switch is convolution and torch.is_autocast_enabled("cuda")
            switch.fp32_precision = "tf32" if allowed or of_training else "ieee"
        yield
    finally:
        for switch, setting in zip(switches, before, strict=True):
            switch.fp32_precision = setting


def rounded_call(module: nn.Module, weights: dict[str, Tensor], *inputs: Any) -> Any:
    """Return module(*inputs) with some of its weights replaced by name."""
    if not weights:
        return module(*inputs)
    return functional_call(module, weights, inputs)


def rounded_weights(
    module: nn.Module, device: torch.device, parts: Iterable[nn.Module] | None = None
) -> dict[str, Tensor]:
    """Return a module's matrices rounded as by autocast, by name; empty without autocast.

    Args:
        parts: submodules of which all weights are rounded, in place of the matrices.
    """
    kind = device.type
    if kind == "meta" or not torch.is_autocast_enabled(kind):
        return {}
    inside = {id(weight) for part in parts or () for weight in part.parameters()}
    rounded = {
        name: weight
        for name, weight in module.named_parameters()
        if weight.dtype == torch.float32
        and (weight.ndim > 1 if parts is None else id(weight) in inside)
    }
    if not rounded:
        return {}
    values = _RoundTogether.apply(torch.get_autocast_dtype(kind), *rounded.values())
    return dict(zip(rounded, values, strict=True))


class _RoundTogether(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, to: torch.dtype, *weights: Tensor) -> tuple[Tensor, ...]:
        return _copy_as(weights, to)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_copy_as(grads, torch.float32)


def _copy_as(tensors: Iterable[Tensor], to: torch.dtype) -> tuple[Tensor, ...]:
    sources = list(tensors)
    copies = [torch.empty_like(tensor, dtype=to) for tensor in sources]
    torch._foreach_copy_(copies, sources)
    return tuple(copies)
