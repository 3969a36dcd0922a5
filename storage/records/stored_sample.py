"""A sample whose pictures stay packed until they are asked for, view by view.

A training step looks at two of a scene's four views or more, and unpacking a picture takes longer
than all else that is done to it. What is asked for obeys the same laws as a whole sample's
(`Sample.check`); of the other pictures nothing is said.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.exr import FIRST_ILLEGAL, Stored, decode_stored, to_float32
from storage.records.held_maps import HeldMaps
from storage.records.sample import (
    SceneRecord,
    check_lights,
    check_radiance,
    decode_lights,
    decode_scene,
    name_errors,
    require_lawful,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredSample(SceneRecord):
    """One scene, which passes `Scene.check`, with its packed pictures."""

    members: Mapping[str, bytes]
    """Bytes of the sample's members in the shard, by suffix."""

    def pictures(self, views: Sequence[int]) -> Stored:
        """Return the pictures of some views [V, R, R, 3], at least one, as they are stored.

        Bits of half floats, uint16, each below FIRST_ILLEGAL; float32 where one is stored so.

        Raises:
            TrilightError: one is missing, unreadable, not square, of another size than the others,
                or holds a radiance that is not finite or below 0.
        """
        with name_errors(self.key):
            pictures = [decode_stored(self.members[f"{view}.exr"]) for view in views]
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
        with name_errors(self.key):
            size = (resolution, resolution)
            lights_rgb = decode_lights(self.scene, views, size, self.members)
        if lights_rgb is not None:
            for view, lights in zip(views, lights_rgb, strict=True):
                check_lights(self.key, lights[None], first_view=view)
        return lights_rgb


def stored_sample(
    key: str, members: Mapping[str, bytes], held: HeldMaps | None = None
) -> StoredSample:
    """Return the sample of its members; `held` as `decode_scene`.

    Raises:
        TrilightError: its scene or record is missing, unreadable or breaks a law, or it has not as
            many records of views, and pictures, as cameras.
    """
    record = decode_scene(key, members, held)
    require_lawful(record)
    suffixes = (f"{view}.exr" for view in range(len(record.views)))
    if missing := [suffix for suffix in suffixes if suffix not in members]:
        raise TrilightError(f"sample {key}: {missing[0]!r} is missing.")
    return StoredSample(**vars(record), members=members)
