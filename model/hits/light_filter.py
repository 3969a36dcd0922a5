"""Denoising of mirrored light: a filter whose weights are learned, never the light itself.

One ray of a pixel says what its glossy surface shows, with much noise. Pixels that see like things
may share what their rays found: each level mixes three by three pixels, as far apart as the level
says (a trous: Dammertz et al. 2010), by how alike the network finds them and how far it trusts each
ray. Light is divided by specular albedo before, and multiplied after, so that patterns stay sharp;
weights have no color, so that the picture stays linear in the light.
"""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad, silu, softplus

STEPS_PX = (1, 2, 4, 8)
"""Pixels between those that a level mixes."""

TAPS = 9
"""Pixels that a level mixes for each: three by three."""

_ALIKE = 8
"""Numbers by which pixels are alike."""

_AROUND_PX = (3, 7)
"""Widths of the squares whose mean light is a feature of each pixel."""

_DARKEST = 1e-4
"""Specular albedo that a mixture is divided by at least."""

_ROWS = 32
"""Rows of a picture that are mixed at a time while rendering: they stay in the CPU's cache.
"""

_MOST_DOUBT = 30.0
"""A ray that is not trusted at all counts e^-30: its pixel, all alone, still shows it."""


def filter_flops(num_features: int, width: int, pixels: int) -> int:
    """Return the FLOPs of filtering a picture of so many pixels."""
    first = (num_features + 3 * len(_AROUND_PX)) * width + width * width
    level = 3 * width + width * (_ALIKE + 1) + TAPS * (_ALIKE + 6)
    return 2 * pixels * (first + len(STEPS_PX) * level)


class LightFilter(nn.Module):
    """Features of pixels and their mirrored light -> mirrored light with less noise."""

    def __init__(self, num_features: int, width: int) -> None:
        super().__init__()
        self.first = nn.Linear(num_features + 3 * len(_AROUND_PX), width)
        self.second = nn.Linear(width, width)
        self.light = nn.ModuleList(nn.Linear(3, width) for _ in STEPS_PX)
        self.alike = nn.ModuleList(nn.Linear(width, _ALIKE + 1) for _ in STEPS_PX)
        self.near = nn.Parameter(torch.zeros(len(STEPS_PX), TAPS))

    def forward(self, features_VRRF: Tensor, light_VRR3: Tensor, albedo_VRR3: Tensor) -> Tensor:
        """Return the mixed light [V, R, R, 3], of at least 0; linear in `light` for equal weights.

        Args:
            features_VRRF: features of each pixel.
            light_VRR3: what its ray brought, in units of the scene's light.
            albedo_VRR3: the specular albedo that it was multiplied by.
        """
        both = torch.cat([light_VRR3, albedo_VRR3], dim=-1).movedim(-1, 1)
        around = [_log_light(_mean_around(both, width)) for width in _AROUND_PX]
        known_VRRW = self.second(silu(self.first(torch.cat([features_VRRF, *around], dim=-1))))
        levels = zip(STEPS_PX, self.light, self.alike, self.near, strict=True)
        for step, light, alike, near in levels:
            at_level = silu(known_VRRW + light(_log_light(both)))
            both = self.mix_level(alike(at_level).movedim(-1, 1), near, both, step)
        return _without_albedo(both).movedim(1, -1) * albedo_VRR3

    @staticmethod
    def mix_level(alike_VCRR: Tensor, near_9: Tensor, both_V6RR: Tensor, step: int) -> Tensor:
        """Return one level's light and albedo [V, 6, R, R], mixed with the same weights.

        It is a hundred kernels, or one compiled.
        """
        height = both_V6RR.shape[2]
        frame = (step, step, step, step)
        trust = torch.exp(-softplus(-alike_VCRR[:, _ALIKE:]).clamp(max=_MOST_DOUBT))
        around = pad(torch.cat([alike_VCRR[:, :_ALIKE], trust, both_V6RR], dim=1), frame)
        rows = _ROWS if around.device.type == "cpu" and not torch.is_grad_enabled() else height
        return torch.cat(
            [
                _mix_rows(around[:, :, first : first + rows + 2 * step], near_9, step)
                for first in range(0, height, rows)
            ],
            dim=2,
        )


def _without_albedo(both_V6RR: Tensor) -> Tensor:
    return both_V6RR[:, :3] / both_V6RR[:, 3:].clamp(min=_DARKEST)


def _log_light(both_V6RR: Tensor) -> Tensor:
    """Return light without albedo as the network reads it, log(1 + 4 light), [V, R, R, 3]."""
    return torch.log1p(4 * _without_albedo(both_V6RR)).movedim(1, -1)


def _mean_around(both_V6RR: Tensor, width: int) -> Tensor:
    """Return means over squares, by rows and then by columns: a fifth of the time of both at once.

    At the rim only what is inside counts.
    """
    half = width // 2
    rows = avg_pool2d(both_V6RR, (1, width), 1, (0, half), count_include_pad=False)
    return avg_pool2d(rows, (width, 1), 1, (half, 0), count_include_pad=False)


def _mix_rows(around_VCRR: Tensor, near_9: Tensor, step: int) -> Tensor:
    """Return [V, 6, rows, R] from all numbers of pixels with a frame around, 0 outside."""
    height, width = (size - 2 * step for size in around_VCRR.shape[2:])
    center = around_VCRR[:, :_ALIKE, step : step + height, step : step + width]
    total: Tensor | float = 0.0
    shares: Tensor | float = 0.0
    for tap, near in enumerate(near_9):
        row = tap // 3 * step
        column = tap % 3 * step
        neighbor = around_VCRR[:, :, row : row + height, column : column + width]
        unlike = (center - neighbor[:, :_ALIKE]).square().sum(dim=1, keepdim=True)
        share = torch.exp(near - unlike) * neighbor[:, _ALIKE : _ALIKE + 1]
        total = total + share * neighbor[:, _ALIKE + 1 :]
        shares = shares + share
    return cast(Tensor, total / shares)
