"""Traced light without noise: Open Image Denoise filters it before a network reads it."""

from dataclasses import replace

import torch
from torch import Tensor

from model.config import HitStage
from model.hits.traced import Traced
from model.hits.view_inputs import Channel
from storage.denoiser import Features, denoise, gpu_is_supported

_SUMMED = (Channel.SHOWN_DIFFUSE, Channel.DIRECT_SPECULAR, Channel.MIRRORED)


def denoise_traced(traced: Traced, stage: HitStage) -> Traced:
    """Return views whose direct and mirrored light is filtered as one picture, where a stage asks.

    It is in SHOWN_DIFFUSE; DIRECT_SPECULAR and MIRRORED become 0: two filters cost twice as much
    and were no better. Light is filtered in units of the scene's, so that pictures scale with the
    lamps.

    Args:
        traced: views of one scene, or of a batch; on any device.
        stage: of the network.
    """
    resolution = traced.pixels_VRRC.shape[-2]
    if not stage.denoises(resolution):
        return traced
    unit = traced.unit_3[..., None, None, None, :].expand(*traced.pixels_VRRC.shape[:-3], 1, 1, 3)
    views = traced.pixels_VRRC.clone()
    for view_RRC, unit_113 in zip(views.flatten(0, -4), unit.flatten(0, -4), strict=True):
        _denoise_view(view_RRC, unit_113)
    return replace(traced, pixels_VRRC=views)


def _denoise_view(view_RRC: Tensor, unit_113: Tensor) -> None:
    """Filter the light of a view in place, on its GPU where the denoiser runs there."""
    light = torch.zeros_like(view_RRC[..., Channel.SHOWN_DIFFUSE])
    for part in _SUMMED:
        light += view_RRC[..., part]
        view_RRC[..., part] = 0
    coverage = view_RRC[..., Channel.COVERAGE]
    albedo = coverage * (view_RRC[..., Channel.DIFFUSE] + view_RRC[..., Channel.SPECULAR])
    normal = coverage * view_RRC[..., Channel.NORMAL]
    color, *guides = (each.float().cpu().numpy() for each in (light / unit_113, albedo, normal))
    on_gpu = view_RRC.is_cuda and gpu_is_supported()
    filtered = denoise(
        color,
        Features(albedo=guides[0], normal=guides[1]),
        "fast",
        threads=1,
        device="CUDA" if on_gpu else None,
    )
    view_RRC[..., Channel.SHOWN_DIFFUSE] = unit_113 * torch.from_numpy(filtered).to(view_RRC)
