"""Traced light without noise: Open Image Denoise filters it before a network reads it."""

import numpy as np
import torch
from torch import Tensor

from model.hits.view_inputs import Channel
from storage.denoiser import Features, denoise


def denoise_light(pixels_VRRC: Tensor, unit_3: Tensor) -> Tensor:
    """Return views [V, R, R, 40] whose direct and mirrored light is filtered as one picture.

    It is in SHOWN_DIFFUSE; DIRECT_SPECULAR and MIRRORED become 0: two filters cost twice as much
    and were no better. One thread of the CPU filters, in units of the scene's light, so that
    pictures scale with the lamps.

    Args:
        pixels_VRRC: float32 by `Channel`, on any device; overwritten on the CPU.
        unit_3: mean light of the scene, by color.
    """
    views = pixels_VRRC.cpu().numpy()
    unit = unit_3.cpu().numpy()
    for view in views:
        light = np.zeros_like(view[..., Channel.SHOWN_DIFFUSE])
        for part in (Channel.SHOWN_DIFFUSE, Channel.DIRECT_SPECULAR, Channel.MIRRORED):
            light += view[..., part]
            view[..., part] = 0
        coverage = view[..., Channel.COVERAGE]
        albedo = coverage * (view[..., Channel.DIFFUSE] + view[..., Channel.SPECULAR])
        guides = Features(albedo=albedo, normal=coverage * view[..., Channel.NORMAL])
        light = denoise(light / unit, guides, "fast", threads=1)
        view[..., Channel.SHOWN_DIFFUSE] = unit * light
    return torch.from_numpy(views).to(pixels_VRRC.device)
