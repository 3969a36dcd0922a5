"""Traced light without noise: Open Image Denoise filters it before a network reads it."""

import torch
from torch import Tensor

from model.hits.view_inputs import Channel
from storage.denoiser import Features, denoise


def denoise_light(pixels_VRRC: Tensor, unit_3: Tensor) -> Tensor:
    """Return views [V, R, R, 40] with direct and mirrored light filtered, each as one picture.

    SHOWN_DIFFUSE becomes all direct light, DIRECT_SPECULAR 0. One thread of the CPU filters, in
    units of the scene's light, so that pictures scale with the lamps.

    Args:
        pixels_VRRC: float32 by `Channel`, on any device; overwritten on the CPU.
        unit_3: mean light of the scene, by color.
    """
    views = pixels_VRRC.cpu().numpy()
    unit = unit_3.cpu().numpy()
    for view in views:
        view[..., Channel.SHOWN_DIFFUSE] += view[..., Channel.DIRECT_SPECULAR]
        view[..., Channel.DIRECT_SPECULAR] = 0
        coverage = view[..., Channel.COVERAGE]
        albedo = coverage * (view[..., Channel.DIFFUSE] + view[..., Channel.SPECULAR])
        guides = Features(albedo=albedo, normal=coverage * view[..., Channel.NORMAL])
        for light in (Channel.SHOWN_DIFFUSE, Channel.MIRRORED):
            view[..., light] = unit * denoise(view[..., light] / unit, guides, "fast", threads=1)
    return torch.from_numpy(views).to(pixels_VRRC.device)
