"""A float32 network, parts of which round as if they computed in a narrower type.

`set_precision` can only switch whole layers. Here a layer, a norm, an attention kernel or a table
of sines is rounded alone: its weights, what goes in and what comes out, with float32 between, as
the kernels of a narrow type sum too. So parts can be told apart, and float16 can be judged on a
processor that refuses it.
"""

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention
from torch.overrides import TorchFunctionMode

from model.layers import CrossAttention, Norm, SelfAttention, SwiGLU
from model.precision import rounded_parts
from model.renderformer import RenderFormer

Round = Callable[[Tensor], Tensor]
Function = Callable[..., Tensor]

_LEAVES = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d, Norm)
_CONTEXT = ("cross.context_norm", "cross.k", "cross.v")
"""Of a decoder layer: what makes keys and values, once per scene."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """What can be rounded alone."""

    name: str
    """In words."""
    narrow: bool
    """Whether `set_precision` rounds it."""
    apply: Callable[[Round], None]
    """Makes the network that it belongs to round it from now on."""


def parts_of(model: RenderFormer) -> list[Part]:
    """Return every part of a network, first those that any precision leaves in float32."""
    return [*_kept_parts(model), *_encoder_parts(model), *_decoder_parts(model)]


def rounded(model: RenderFormer, names: Iterable[str], dtype: torch.dtype) -> RenderFormer:
    """Return a copy of a float32 network with the named parts rounded; others stay as they are."""
    wanted = set(names)
    model = copy.deepcopy(model)
    parts = {part.name: part for part in parts_of(model)}
    assert wanted <= set(parts), wanted - set(parts)
    for name in wanted:
        parts[name].apply(rounding_to(dtype))
    return model


def rounding_to(dtype: torch.dtype) -> Round:
    """Return what rounds to a type's numbers and keeps float32."""
    return lambda x: x.to(dtype).to(x.dtype)


def _kept_parts(model: RenderFormer) -> list[Part]:
    rotary, tokens, decoder = model.encoder.rotary, model.encoder.tokens, model.decoder
    cosines = (Tensor.cos, Tensor.sin)
    triangle_tokens = [tokens.token_W, model.encoder.registers_NW]
    narrow = {leaf for module in rounded_parts(model) for leaf in _leaves(module)}
    last = [leaf for leaf in _leaves(decoder.head) if leaf not in narrow]
    return [
        _kept("vertex positions", lambda r: _round_inputs(rotary, r)),
        _kept("rotary angles", lambda r: _intercept([rotary], cosines, _of_rounded(r))),
        _kept("their sines and cosines", lambda r: _round_output(rotary, r)),
        _kept("vertex normals", lambda r: _round_inputs(tokens, r, only=1)),
        _kept("materials", lambda r: _round_inputs(tokens, r, only=0)),
        _kept("layers of the triangle tokens", _layers(_leaves(tokens), triangle_tokens)),
        _kept(
            "ray directions and their layer",
            _layers([decoder.rays, decoder.rays_norm], [decoder.token_W]),
        ),
        _kept("last layers of the head", _layers(last)),
    ]


def _kept(name: str, apply: Callable[[Round], None]) -> Part:
    return Part(name=name, narrow=False, apply=apply)


def _encoder_parts(model: RenderFormer) -> list[Part]:
    return _stage_parts("encoder", model.encoder.layers)


def _decoder_parts(model: RenderFormer) -> list[Part]:
    layers = model.decoder.layers
    context = [layer.get_submodule(name) for layer in layers for name in _CONTEXT]
    head = [leaf for module in model.decoder.head.rounded_parts() for leaf in _leaves(module)]
    parts = [
        Part(name="decoder: keys and values of the scene", narrow=True, apply=_layers(context)),
        *_stage_parts("decoder", layers, apart=context),
    ]
    if head:
        parts.append(Part(name="convolutions of the head", narrow=True, apply=_layers(head)))
    return parts


def _stage_parts(stage: str, layers: nn.ModuleList, apart: Sequence[nn.Module] = ()) -> list[Part]:
    """Return the parts of a stage, of all its layers together, without those that stand apart."""
    named = [(name, leaf) for name, leaf in layers.named_modules() if isinstance(leaf, _LEAVES)]
    named = [(name, leaf) for name, leaf in named if leaf not in apart]
    mlps = [leaf for m in layers.modules() if isinstance(m, SwiGLU) for leaf in _leaves(m)]
    linear = [leaf for _, leaf in named if isinstance(leaf, nn.Linear) and leaf not in mlps]
    qk_norms = [leaf for name, leaf in named if name.endswith(("q_norm", "k_norm"))]
    norms = [leaf for _, leaf in named if isinstance(leaf, Norm) and leaf not in qk_norms]
    attention = [m for m in layers.modules() if isinstance(m, SelfAttention | CrossAttention)]
    applied: dict[str, Callable[[Round], None]] = {
        "products around attention": _layers(linear),
        "attention kernel": lambda r: _intercept(
            attention, (scaled_dot_product_attention,), _narrow_kernel(r)
        ),
        "MLPs": _layers(mlps),
        "norms before the layers": _layers(norms),
        "norms of queries and keys": _layers(qk_norms),
        "residual stream, after each layer": lambda r: _round_outputs(layers, r),
    }
    return [
        Part(name=f"{stage}: {name}", narrow=True, apply=apply) for name, apply in applied.items()
    ]


def _leaves(module: nn.Module) -> list[nn.Module]:
    return [leaf for leaf in module.modules() if isinstance(leaf, _LEAVES)]


def _layers(
    leaves: Sequence[nn.Module], learned: Sequence[nn.Parameter] = ()
) -> Callable[[Round], None]:
    """Return what rounds layers: their weights, what they get and what they give."""

    def apply(r: Round) -> None:
        with torch.no_grad():
            for weight in [*learned, *(w for leaf in leaves for w in leaf.parameters())]:
                weight.copy_(r(weight))
        for leaf in leaves:
            _round_inputs(leaf, r)
            _round_output(leaf, r)

    return apply


def _round_inputs(module: nn.Module, r: Round, only: int | None = None) -> None:
    """Round the tensors that a module gets, or that one of them."""

    def hook(_: nn.Module, inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return tuple(r(x) if only in (None, index) else x for index, x in enumerate(inputs))

    module.register_forward_pre_hook(hook)


def _round_output(module: nn.Module, r: Round) -> None:
    def hook(_: nn.Module, inputs: object, output: Any) -> Any:
        return tuple(r(x) for x in output) if isinstance(output, tuple) else r(output)

    module.register_forward_hook(hook)


def _round_outputs(modules: Iterable[nn.Module], r: Round) -> None:
    for module in modules:
        _round_output(module, r)


class _Intercepting(TorchFunctionMode):
    """While it is entered, some of torch's functions go through another."""

    def __init__(self, functions: Sequence[Function], instead: Callable[..., Tensor]) -> None:
        super().__init__()
        self._functions, self._instead = functions, instead

    def __torch_function__(
        self, func: Function, types: object, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        """Call `instead(func, ...)` for those, and all else as it is."""
        if func in self._functions:
            return self._instead(func, *args, **(kwargs or {}))
        return func(*args, **(kwargs or {}))


def _intercept(
    modules: Iterable[nn.Module], functions: Sequence[Function], instead: Callable[..., Tensor]
) -> None:
    """Send functions through another for as long as one of the modules computes."""
    for module in modules:
        mode = _Intercepting(functions, instead)

        def enter(_: nn.Module, inputs: object, mode: _Intercepting = mode) -> None:
            mode.__enter__()

        def leave(_: nn.Module, inputs: object, output: object, mode: _Intercepting = mode) -> None:
            mode.__exit__(None, None, None)

        module.register_forward_pre_hook(enter)
        module.register_forward_hook(leave, always_call=True)


def _of_rounded(r: Round) -> Callable[..., Tensor]:
    return lambda function, x: function(r(x))


def _narrow_kernel(r: Round) -> Callable[..., Tensor]:
    """Return what gives the kernel rounded queries, keys and values, and rounds its answer."""

    def instead(function: Function, q: Tensor, k: Tensor, v: Tensor, **further: Any) -> Tensor:
        return r(function(r(q), r(k), r(v), **further))

    return instead
