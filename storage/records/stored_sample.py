"""A sample whose pictures stay packed until they are asked for, view by view.

A training step looks at two of a scene's four views or more, and unpacking a picture takes longer
than all else that is done to it. What is asked for obeys the same laws as a whole sample's
(`Sample.check`); of the other pictures nothing is said.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.exr import FIRST_ILLEGAL, Stored, decode_stored, to_float32
from storage.records.held_maps import HeldMaps
from storage.records.lights import decode_lights_exr, num_lights
from storage.records.sample import ViewRecord, check_radiance, decode_scene
from storage.records.scene import Scene

Picture = TypeVar("Picture")


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredSample:
    """One scene, which passes `Scene.check`, with its packed pictures."""

    key: str
    """The scene's index, nine digits."""
    scene: Scene
    views: tuple[ViewRecord, ...]
    """One record per camera, in their order."""
    members: Mapping[str, bytes]
    """Bytes of the sample's members in the shard, by suffix."""

    def pictures(self, views: Sequence[int]) -> Stored:
        """Return the pictures of some views [V, R, R, 3], at least one, as they are stored.

        Bits of half floats, uint16, each below FIRST_ILLEGAL; float32 where one is stored so.

        Raises:
            TrilightError: one is missing, unreadable, not square, of another size than the others,
                or holds a radiance that is not finite or below 0.
        """
        pictures: list[Stored] = [self._read(f"{view}.exr", decode_stored) for view in views]
        if any(picture.dtype == np.float32 for picture in pictures):
            pictures = [to_float32(picture) for picture in pictures]
        shapes = {picture.shape for picture in pictures}
        if len(shapes) > 1 or any(height != width for height, width, _ in shapes):
            sizes = ", ".join(sorted(f"{height} x {width}" for height, width, _ in shapes))
            raise TrilightError(
                f"sample {self.key}: pictures of {sizes} pixels; expected squares of one size."
            )
        for view, picture in zip(views, pictures, strict=True):
            if picture.dtype == np.float32 or picture.max() >= FIRST_ILLEGAL:
                check_radiance(self.key, "", to_float32(picture)[None], first_view=view)
        stacked: NDArray = np.stack(pictures)
        if stacked.dtype == np.uint16:  # the only legal one that is not below it is -0
            stacked[stacked >= FIRST_ILLEGAL] = 0
        return stacked

    def lights_rgb(self, views: Sequence[int], resolution: int) -> NDArray[np.float32] | None:
        """Return radiance of each light alone [V, L, R, R, 3]; None where they are together.

        Args:
            views: at least one.
            resolution: R, that of `pictures`.

        Raises:
            TrilightError: as `pictures`.
        """
        if not any(suffix.endswith(".lights.exr") for suffix in self.members):
            return None
        shape = (num_lights(self.scene), resolution, resolution)
        by_view = []
        for view in views:
            suffix = f"{view}.lights.exr"
            lights = self._read(suffix, lambda data: decode_lights_exr(data, shape))
            for light, radiance_rgb in enumerate(lights):
                which = f" light {light}"
                check_radiance(self.key, which, radiance_rgb[None], first_view=view)
            by_view.append(lights)
        return np.stack(by_view)

    def _read(self, suffix: str, decode: Callable[[bytes], Picture]) -> Picture:
        if suffix not in self.members:
            raise TrilightError(f"sample {self.key}: {suffix!r} is missing.")
        try:
            return decode(self.members[suffix])
        except ValueError as error:
            raise TrilightError(f"sample {self.key}: {error}") from error


def stored_sample(
    key: str, members: Mapping[str, bytes], held: HeldMaps | None = None
) -> StoredSample:
    """Return the sample of its members; `held` as `decode_scene`.

    Raises:
        TrilightError: its scene or record is missing, unreadable or breaks a law, or it has not as
            many records of views, and pictures, as cameras.
    """
    record = decode_scene(key, members, held)
    try:
        record.scene.check()
    except TrilightError as error:
        raise TrilightError(f"sample {key}: {error}") from error
    if len(record.views) != record.scene.num_views:
        raise TrilightError(
            f"sample {key}: {len(record.views)} records of views; expected "
            f"{record.scene.num_views}, as many as cameras."
        )
    suffixes = (f"{view}.exr" for view in range(len(record.views)))
    if missing := [suffix for suffix in suffixes if suffix not in members]:
        raise TrilightError(f"sample {key}: {missing[0]!r} is missing.")
    return StoredSample(key=key, scene=record.scene, views=record.views, members=members)
