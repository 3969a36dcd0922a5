"""`LandedLight`: light tracing on the pictures of a scene, once for all its views.

A path takes more than twice as long to trace as to join to a camera. So views whose light paths
have the same seed are joined to them together: those that wait get pictures that they may not need.
What a view gets does not depend on that, to the last bit: each picture has its own sums of whole
numbers (pipeline.renders.film).

Errors of the views of a scene are then correlated. Those of each view are what they were: it has as
many light paths, its halves share none, and what it asks for does not depend on other views.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import Any

from pipeline.renders.camera import PixelCamera

_MOST_PIXELS = 1 << 23
"""Pixels of pictures that wait to be asked for: 100 MB. Beyond them each view traces its own."""


class LandedLight:
    """Pictures of light paths that wait for the view that they belong to."""

    def __init__(self, cameras: Sequence[PixelCamera] = ()) -> None:
        """Begin with the cameras of the views that will be asked for."""
        self._waiting = {_name(camera): camera for camera in cameras}
        self._kept = dict[tuple[Hashable, Hashable], Any]()

    def begin(self, camera: PixelCamera) -> None:
        """Begin a view; pictures of those that were begun before it are dropped."""
        self._waiting.pop(_name(camera), None)
        names = {_name(camera), *self._waiting}
        self._kept = {key: picture for key, picture in self._kept.items() if key[0] in names}

    def take(
        self,
        camera: PixelCamera,
        paths: Hashable,
        land: Callable[[Sequence[PixelCamera]], Sequence[Any]],
    ) -> Any:
        """Return the picture of a view, once.

        Args:
            camera: the view.
            paths: what tells these light paths from others.
            land: returns the picture of each of some cameras.
        """
        picture = self._kept.pop((_name(camera), paths), None)
        if picture is not None:
            return picture
        waiting = self._waiting
        pixels = camera.resolution**2
        if (len(self._kept) + len(waiting)) * pixels > _MOST_PIXELS:
            waiting = {}
        pictures = iter(land([camera, *waiting.values()]))
        picture = next(pictures)
        self._kept |= {(name, paths): each for name, each in zip(waiting, pictures, strict=True)}
        return picture


def _name(camera: PixelCamera) -> Hashable:
    return camera.c2w.tobytes(), camera.fov_deg, camera.resolution
