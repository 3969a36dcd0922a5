"""Baselines that ignore the scene, and other pictures that are looked up and not rendered.

A network that does not beat the baselines has learned nothing. The nearest training view is the
training picture closest to the target itself. No method that looks up a training picture by the
scene can do better.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.conventions import log10_radiance, radiance_from_log10
from storage.errors import TrilightError
from storage.records.sample import Sample
from storage.renderer import fingerprint
from train.data.scenes import TrainingScene, block_mean

MEDIAN = "median picture"
NEAREST = "nearest training view"

COMPARED_PX = 32
"""Maximum width in pixels at which pictures are compared."""


class Baselines:
    """Baseline pictures from some training scenes."""

    def __init__(self, scenes: Iterable[TrainingScene]) -> None:
        # half floats take half the memory, and an error of a thousandth does not matter here
        named = [(scene.key, scene.target_VRR3.numpy().astype(np.float16)) for scene in scenes]
        self._keys_M = np.array([key for key, pictures in named for _ in pictures])
        self._log10_MRR3 = np.concatenate([pictures for _, pictures in named])
        self._small_MRR3 = _small(self._log10_MRR3)

    @functools.cached_property
    def _median_RR3(self) -> NDArray[np.float64]:
        return median_picture([self._log10_MRR3])

    def pictures(self, target_rgb: NDArray) -> dict[str, NDArray[np.float64]]:
        """Return each baseline's picture for a target [R, R, 3], linear radiance."""
        return {MEDIAN: self._median_RR3, NEAREST: self.nearest(target_rgb)}

    def nearest(self, target_rgb: NDArray, *, not_of: str = "") -> NDArray[np.float64]:
        """Return the training picture [R, R, 3] that is closest to a target, linear radiance.

        Args:
            target_rgb: [R, R, 3] linear radiance.
            not_of: key of a scene whose pictures are excluded.

        Raises:
            TrilightError: all pictures are of that scene.
        """
        small = _small(log10_radiance(target_rgb)[None])
        distance_M = np.abs(self._small_MRR3 - small).mean(axis=(1, 2, 3))
        is_other_M = self._keys_M != not_of
        if not is_other_M.any():
            raise TrilightError(
                f"nearest view: scene {not_of} is alone; expected a second scene to look up."
            )
        nearest = int(np.where(is_other_M, distance_M, np.inf).argmin())
        return radiance_from_log10(self._log10_MRR3[nearest].astype(np.float64))


def median_picture(log10_pictures: Sequence[NDArray]) -> NDArray[np.float64]:
    """Return the per-pixel median radiance [R, R, 3] over all views.

    No other fixed picture has a smaller L1 error, in any monotonic space.

    Args:
        log10_pictures: log10(1 + radiance) of the views [V, R, R, 3] of each scene.
    """
    median_RR3 = np.median(np.concatenate(log10_pictures), axis=0)
    return radiance_from_log10(median_RR3.astype(np.float64))


def _small(log10_MRR3: NDArray) -> NDArray[np.float32]:
    count, resolution = log10_MRR3.shape[:2]
    factor = max(resolution // COMPARED_PX, 1)
    cropped_px = resolution // factor * factor
    cropped = log10_MRR3[:, :cropped_px, :cropped_px].astype(np.float32)
    blocks = cropped.reshape(count, cropped_px // factor, factor, cropped_px // factor, factor, 3)
    return blocks.mean(axis=(2, 4))


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
