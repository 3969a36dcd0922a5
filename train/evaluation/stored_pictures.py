"""Stored pictures that are judged beside renderers: looked up, not rendered, without a price."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.records.sample import Sample
from storage.renderer import fingerprint
from train.data.scenes import block_mean
from train.evaluation.baselines import Baselines


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureSource:
    """Pictures of one width, by the scene's key and the camera's row."""

    name: str
    """Name of the row, unique on a leaderboard."""
    resolution: int
    """Width and height of the pictures in pixels."""
    digest: Callable[[str, int], str]
    """Returns the digest of everything that decides the picture of a view."""
    pictures: Callable[[Sample], NDArray[np.floating]]
    """Returns the pictures [V, R, R, 3] of a sample, linear radiance of at least 0."""


def nearest_view(
    name: str, resolution: int, read: Callable[[], Baselines], *, pool: str, not_itself: bool
) -> PictureSource:
    """Return the lookup of the picture of another scene that is nearest to the target.

    It is the bound of any lookup: it uses the target itself, so that no method that looks up a
    picture by the scene can be better.

    Args:
        read: returns the pictures of the lookup; called when the first one is needed.
        pool: digest of the dataset of these pictures.
        not_itself: whether the evaluated scenes are among them.
    """
    baselines = functools.cache(read)

    def pictures(sample: Sample) -> NDArray[np.floating]:
        targets = block_mean(sample.radiance_rgb, resolution)
        itself = sample.key if not_itself else ""
        return np.stack([baselines().nearest(target, not_of=itself) for target in targets])

    digest = fingerprint({"pool": pool})
    return PictureSource(
        name=name, resolution=resolution, digest=lambda key, view: digest, pictures=pictures
    )
