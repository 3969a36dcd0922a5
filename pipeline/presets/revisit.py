"""Settings of a dataset that renders the scenes of a finished one again with changes."""

from typing import Annotated, Literal

from scene_templates.templates import TEMPLATES
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import FLOAT32_MAX, Within

MOST_CAMERAS = 1000
"""Cameras of a scene; given ones stand in the manifest."""

_POSE = 16


@checked("revisit settings")
class GivenCamera:
    """A camera of every scene."""

    c2w: Annotated[tuple[float, ...], Within(-FLOAT32_MAX, FLOAT32_MAX)]
    """Camera to world, 4 x 4, row by row."""
    fov_deg: Annotated[float, Within(0, 180, low_open=True, high_open=True, unit="degrees")]
    """Full field of view of the camera."""

    def __post_init__(self) -> None:
        if len(self.c2w) != _POSE:
            raise TrilightError(f"c2w is {len(self.c2w)} numbers; expected {_POSE}.")


@checked("revisit settings")
class RevisitSettings:
    """Changes to the scenes of a finished dataset."""

    source_digest: str
    """Dataset digest of the finished dataset."""
    kept_cameras: Annotated[int, Within(0, MOST_CAMERAS, unit="cameras")]
    """Number of cameras that each scene keeps, from its first."""
    new_cameras: Annotated[int, Within(0, MOST_CAMERAS, unit="cameras")] = 0
    """Number of cameras that are drawn for each scene after those: where it keeps some and no
    layout is named, the ones that a dataset with more views would have had; else new ones, by the
    dataset's seed."""
    camera_layout: str | None = None
    """Layout that draws the new cameras; by default each scene's own."""
    given_cameras: tuple[GivenCamera, ...] = ()
    """Cameras that each scene gets after those; by default there are none."""
    lights: Literal["keep", "new"] = "keep"
    """Choice to keep the lights, or to draw new ones by `scenes.lights` and each scene's layout."""
    num_lights: Annotated[int | None, Within(1, 64, unit="emitters")] = None
    """Number of the new lights of each scene; by default as many as it has."""
    materials: Literal["keep", "new"] = "keep"
    """Choice to keep the materials, or to draw new ones by `scenes.materials`; faces that share a
    color still do."""

    def __post_init__(self) -> None:
        if not 1 <= self.num_views <= MOST_CAMERAS:
            raise TrilightError(
                f"cameras: {self.num_views} for each scene; expected 1 to {MOST_CAMERAS}."
            )
        if self.camera_layout is not None:
            TEMPLATES.find(self.camera_layout)
        if self.num_lights is not None and self.lights == "keep":
            raise TrilightError("num_lights: expected it only where lights are new.")

    @property
    def num_views(self) -> int:
        """Number of views of each scene."""
        return self.kept_cameras + self.new_cameras + len(self.given_cameras)

    @property
    def keeps_light(self) -> bool:
        """True if only cameras change, so that a kept camera sees the same picture."""
        return self.lights == "keep" and self.materials == "keep"
