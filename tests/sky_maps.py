"""Environment maps whose light is known, for tests."""

from typing import Any

import numpy as np

from storage.conventions import latlong_direction
from storage.records.texture import Environment

POLES = {"+X": (1, 0, 0), "-X": (-1, 0, 0), "+Y": (0, 1, 0), "-Y": (0, -1, 0), "+Z": (0, 0, 1),
         "-Z": (0, 0, -1)}  # fmt: skip
"""Direction of each pole."""

COLOURS = {"+X": (9, 1, 1), "-X": (1, 9, 9), "+Y": (1, 9, 1), "-Y": (9, 1, 9), "+Z": (1, 1, 9),
           "-Z": (9, 9, 1)}  # fmt: skip
"""Radiance that `six_poles` has there."""


def centres(height: int) -> np.ndarray:
    """Return the directions [H, 2 H, 3] of the centres of a map's texels."""
    v, u = 1 - (np.arange(height) + 0.5) / height, (np.arange(2 * height) + 0.5) / (2 * height)
    return latlong_direction(np.stack(np.meshgrid(u, v), axis=-1))


def as_sky(radiance_rgb: Any, **changes: Any) -> Environment:
    """Return a map of radiance [H, 2 H, 3]."""
    found = Environment(radiance_rgb=np.asarray(radiance_rgb, np.float32), **changes)
    found.check()
    return found


def constant(radiance: Any = 1.0, height: int = 8, **changes: Any) -> Environment:
    return as_sky(np.zeros((height, 2 * height, 3)) + np.asarray(radiance), **changes)


def six_poles(height: int = 32, **changes: Any) -> Environment:
    """Return a map whose colour about each axis is one of COLOURS."""
    along = np.stack([centres(height) @ np.array(d) for d in POLES.values()], axis=-1)
    return as_sky(np.array([*COLOURS.values()])[along.argmax(axis=-1)], **changes)


def smooth(height: int = 24, **changes: Any) -> Environment:
    """Return a coloured sky, bright in one direction, that differs in all others."""
    x, y, z = np.moveaxis(centres(height), -1, 0)
    red, green, blue = 0.6 + 0.5 * x, 0.6 + 0.4 * y * z, 0.7 + 0.4 * z - 0.2 * x
    return as_sky(np.stack([red, green, blue], axis=-1), **changes)


def one_sun(radiance: float = 1e5, height: int = 64, **changes: Any) -> Environment:
    """Return a dim sky with a sun in one texel, high above +X and a little -Y."""
    texels = np.full((height, 2 * height, 3), 0.2, np.float32)
    texels[height // 4, height + 3] = np.array([1.0, 0.9, 0.7]) * radiance
    return as_sky(texels, **changes)


def night(height: int = 32, **changes: Any) -> Environment:
    """Return a black sky with three lamps of two to four texels."""
    texels = np.zeros((height, 2 * height, 3), np.float32)
    texels[9, 20:22], texels[12, 50:54], texels[4:6, 40] = (60, 40, 20), (5, 10, 20), (30, 30, 10)
    return as_sky(texels, **changes)
