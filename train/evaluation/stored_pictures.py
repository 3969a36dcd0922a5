"""Stored pictures that are judged beside renderers: looked up, not rendered, without a price."""

from collections.abc import Callable, Mapping
from importlib import metadata

import numpy as np
from numpy.typing import NDArray

from storage.digests import canonical_json, sha256_hex
from storage.records.sample import Sample
from train.data.resolution import block_mean
from train.evaluation.baselines import Baselines


class StoredPictures:
    """Pictures of one width, by the scene's key and the camera's row."""

    name: str
    """Name in rows."""
    resolution: int
    """Width and height of the pictures in pixels."""

    def digest(self, key: str, view: int) -> str:
        """Return the digest of everything that decides the picture of a view."""
        raise NotImplementedError

    def pictures(self, sample: Sample) -> NDArray[np.floating]:
        """Return the pictures [V, R, R, 3] of a sample, linear radiance of at least 0.

        Raises:
            TrilightError: a picture cannot be read.
        """
        raise NotImplementedError


class NearestView(StoredPictures):
    """Picture of another scene that is nearest to the target: the bound of any lookup.

    The lookup uses the target itself, so that no method that looks up a picture by the scene can be
    better.
    """

    def __init__(
        self,
        name: str,
        resolution: int,
        baselines: Callable[[], Baselines],
        *,
        pool: str,
        not_itself: bool,
    ) -> None:
        """Store the pictures of the lookup.

        Args:
            name: name of the row.
            resolution: width of the pictures in pixels.
            baselines: returns the pictures of the lookup; called when the first one is needed.
            pool: digest of the dataset of these pictures.
            not_itself: whether the evaluated scenes are among them.
        """
        self.name = name
        self.resolution = resolution
        self._read = baselines
        self._baselines: Baselines | None = None
        self._digest = method_digest({"pool": pool})
        self._not_itself = not_itself

    def digest(self, key: str, view: int) -> str:
        return self._digest

    def pictures(self, sample: Sample) -> NDArray[np.floating]:
        if self._baselines is None:
            self._baselines = self._read()
        targets = block_mean(sample.radiance_rgb, self.resolution)
        itself = sample.key if self._not_itself else ""
        return np.stack([self._baselines.nearest(target, not_of=itself) for target in targets])


def method_digest(identity: Mapping[str, object]) -> str:
    """Return the digest of what decides a method's pictures, this version of Trilight included."""
    return sha256_hex(canonical_json({**identity, "trilight": metadata.version("trilight")}))
