"""`Traced`: traced inputs of scenes and views, as tensors that a network of hits reads."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from model.hits.view_inputs import Channel
from storage.denoiser import gpu_is_supported, open_filter

if TYPE_CHECKING:  # it loads pydantic
    from model.config import ModelConfig

INPUTS = ("open", "direct", "mirrored", "gathered", "tokens")
"""Inputs that a network of hits may lack: light from lamps as if nothing stood between, with its
shadows, light that one mirrored ray brings, light that anchors gather, and the scene's tokens."""

CHANNELS = {
    "open": (Channel.OPEN_DIFFUSE, Channel.OPEN_SPECULAR),
    "direct": (Channel.DIRECT_DIFFUSE, Channel.DIRECT_SPECULAR, Channel.SHOWN_DIFFUSE),
    "mirrored": (Channel.MIRRORED, Channel.SEEN_ALBEDO, Channel.SEEN_NEARNESS),
}
"""Channels of the inputs that pixels have."""


@dataclass(frozen=True, eq=False)
class Traced:
    """Traced inputs of a scene and of V of its views; in a batch, B comes first everywhere."""

    sides_T12: Tensor
    """Direct and indirect irradiance over pi of the front, then of the back, of each triangle."""
    unit_3: Tensor
    """Mean light of the scene, by color (model.hits.radiosity)."""
    pixels_VRRC: Tensor
    """[V, R, R, 40] quantities of each pixel, by `model.hits.view_inputs.Channel`."""
    anchor_VA: Tensor
    """int64 pixel of each anchor."""
    gathered_VA3: Tensor
    """Irradiance over pi from other surfaces, at the anchors."""
    given_VI: Tensor
    """1, or 0 where a view has to do without one of INPUTS."""

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the tensors in the order of the fields."""
        return tuple(getattr(self, each.name) for each in fields(self))

    def without(self, kept_VI: Tensor) -> "Traced":
        """Return the same for views that lack the inputs whose number in `kept_VI` is 0."""
        pixels = self.pixels_VRRC.clone()
        for name, channels in CHANNELS.items():
            for channel in channels:
                pixels[..., channel] *= kept_VI[..., INPUTS.index(name), None, None, None]
        gathered = self.gathered_VA3 * kept_VI[..., INPUTS.index("gathered"), None, None]
        available = self.given_VI * kept_VI
        return replace(self, pixels_VRRC=pixels, gathered_VA3=gathered, given_VI=available)


def stack_traced(scenes: Sequence[Traced]) -> Traced:
    """Return the batch of scenes, their triangles padded with zeros."""
    names = [each.name for each in fields(Traced) if each.name != "sides_T12"]
    return Traced(
        sides_T12=pad_sequence([each.sides_T12 for each in scenes], True),
        **{name: torch.stack([getattr(each, name) for each in scenes]) for name in names},
    )


_SUMMED = (Channel.SHOWN_DIFFUSE, Channel.DIRECT_SPECULAR, Channel.MIRRORED)


def denoise_traced(traced: Traced, config: "ModelConfig") -> Traced:
    """Return views whose direct and mirrored light is filtered as one picture, if a network asks.

    It is in SHOWN_DIFFUSE; DIRECT_SPECULAR and MIRRORED become 0: two filters cost twice as much
    and were no better. Light is filtered in units of the scene's, so that pictures scale with the
    lamps.

    Args:
        traced: views of one scene, or of a batch; on any device.
        config: of the network.
    """
    resolution = traced.pixels_VRRC.shape[-2]
    if not config.denoises(resolution):
        return traced
    unit = traced.unit_3[..., None, None, None, :].expand(*traced.pixels_VRRC.shape[:-3], 1, 1, 3)
    views = traced.pixels_VRRC.clone()
    for view_RRC, unit_113 in zip(views.flatten(0, -4), unit.flatten(0, -4), strict=True):
        _denoise_view(view_RRC, unit_113)
    return replace(traced, pixels_VRRC=views)


def _denoise_view(view_RRC: Tensor, unit_113: Tensor) -> None:
    """Filter the light of a view in place, in a GPU's memory where the denoiser runs there."""
    light = torch.zeros_like(view_RRC[..., Channel.SHOWN_DIFFUSE])
    for part in _SUMMED:
        light += view_RRC[..., part]
        view_RRC[..., part] = 0
    coverage = view_RRC[..., Channel.COVERAGE]
    albedo = coverage * (view_RRC[..., Channel.DIFFUSE] + view_RRC[..., Channel.SPECULAR])
    normal = coverage * view_RRC[..., Channel.NORMAL]
    on_gpu = view_RRC.is_cuda and gpu_is_supported()
    place = torch.device("cuda", 0) if on_gpu else torch.device("cpu")
    color, albedo, normal = (
        each.to(place, torch.float32).contiguous() for each in (light / unit_113, albedo, normal)
    )
    filtered = torch.zeros_like(color)
    images = {"color": color, "albedo": albedo, "normal": normal, "output": filtered}
    if on_gpu:  # the denoiser has a stream of its own
        torch.cuda.current_stream(place).synchronize()
    opened = open_filter(len(view_RRC), "fast", threads=1, device="CUDA" if on_gpu else "CPU")
    opened.run_in_place({name: image.data_ptr() for name, image in images.items()})
    # as `storage.denoiser.denoise`: black without light, and where nothing is met
    is_covered = (normal != 0).any(-1, keepdim=True) | (color != 0).any(-1, keepdim=True)
    filtered = torch.where(is_covered & color.any(), filtered.clamp(min=0), 0)
    view_RRC[..., Channel.SHOWN_DIFFUSE] = unit_113 * filtered.to(view_RRC)
