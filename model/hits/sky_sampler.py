"""Importance sampling of an environment map.

A texel is sampled in proportion to its flux, and a direction within it uniformly by solid angle, so
that most samples hit a sun of one texel. Samples are drawn in the axes of the map, so that a scene
rotated together with its map has the same noise.
"""

import dataclasses
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.hits.vectors import Floats, as_rows
from storage.conventions import latlong_uv
from storage.records.environment import Environment, row_solid_angles, texel_means
from storage.records.lookup import environment_values

_BLURRED_ROWS = 16
"""Number of rows of the blurred map: 11 degrees each."""


class SkySampler:
    """Sampler of an environment map that is not all black."""

    def __init__(self, sky: Environment) -> None:
        # in double precision, in which rays are turned to the map
        self.sky = dataclasses.replace(sky, rotation=sky.rotation.astype(np.float64))
        height, width = sky.radiance_rgb.shape[:2]
        angles = row_solid_angles(height)[:, None]
        flux = texel_means(sky.radiance_rgb.mean(axis=-1, dtype=np.float64)) * angles
        self._probability = flux.ravel() / flux.sum()
        self._cumulative = np.cumsum(self._probability)
        self._pdf = flux / flux.sum() / angles
        self._edges = np.cos(np.pi * np.arange(height + 1) / height)
        self._height = height
        self._width = width

    def sample_directions(self, u: Floats) -> Floats:
        """Return unit world directions [3, P] for numbers u [2, P] in the unit square."""
        first = u[0].astype(np.float64)
        texel = np.searchsorted(self._cumulative, first, side="right").clip(
            0, len(self._probability) - 1
        )
        share = self._probability[texel]
        along = (first - (self._cumulative[texel] - share)) / np.maximum(share, 1e-300)
        row = texel // self._width
        column = texel % self._width
        z = self._edges[row] + (self._edges[row + 1] - self._edges[row]) * u[1]
        azimuth = (0.5 - (column + along.clip(0, 1)) / self._width) * 2 * np.pi
        flat = np.sqrt(np.maximum(1 - z * z, 0))
        local = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z])
        return (self.sky.rotation @ local).astype(np.float32)

    def pdf(self, direction: Floats) -> Floats:
        """Return the probability density [P] of unit directions [3, P], per steradian."""
        u, v = np.moveaxis(latlong_uv(self.sky.to_map(direction.T)), -1, 0)
        row = ((1 - v) * self._height).astype(np.intp).clip(0, self._height - 1)
        column = np.floor(u * self._width).astype(np.intp) % self._width
        return self._pdf[row, column].astype(np.float32)

    def radiance(self, direction: Floats) -> Floats:
        """Return the radiance [3, P] from unit directions [3, P]."""
        return environment_values(self.sky, as_rows(direction)).T.astype(np.float32)

    def blurred_radiance(self, direction: Floats) -> Floats:
        """Return the radiance [3, P] of a blurred map with few rows and the same total flux."""
        return environment_values(self._coarse, as_rows(direction)).T.astype(np.float32)

    @cached_property
    def _coarse(self) -> Environment:
        factor = max(self._height // _BLURRED_ROWS, 1)
        while self._height % factor:
            factor -= 1
        rows = self._height // factor
        angles: NDArray[np.float64] = row_solid_angles(self._height)[:, None, None]
        light = (self.sky.radiance_rgb * angles).reshape(rows, factor, 2 * rows, factor, 3)
        means = (
            light.sum(axis=(1, 3))
            / (factor**2 * angles.reshape(rows, factor).mean(axis=1))[:, None, None]
        )
        return Environment(radiance_rgb=means.astype(np.float32), rotation=self.sky.rotation)
