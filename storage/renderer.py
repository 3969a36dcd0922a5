"""`Renderer`: the one interface to everything that makes a picture of a scene.

A path tracer, a network, traced light without a network and a stored picture all are renderers:
each loads a scene and then renders any camera of it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.scene import Scene

Fact = str | int | float
Facts = Mapping[str, Fact]
"""Facts of a picture by name, which the header of its file holds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """Pose and field of view of a square picture, as storage.conventions means them."""

    c2w: NDArray[np.float32]
    """[4, 4] camera to world."""
    fov_deg: float
    """Full field of view in degrees."""
    view: int | None = None
    """Row of the camera in its scene; None for a camera from elsewhere."""
    name: str = "picture"
    """Name of its picture in messages."""

    @classmethod
    def of_scene(cls, scene: Scene, view: int, named: str = "view") -> "Camera":
        """Return a camera of a scene by its row; raises TrilightError, with `named`, without it."""
        if not 0 <= view < scene.num_views:
            raise TrilightError(
                f"{named} is {view}; expected 0 to {scene.num_views - 1}: the scene has "
                f"{scene.num_views} cameras."
            )
        fov_deg = float(scene.fov_deg[view])
        return cls(c2w=scene.c2w[view], fov_deg=fov_deg, view=view, name=f"view {view}")


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Progress of the samples of a picture."""

    spp: int
    """Samples per pixel so far."""
    expected_spp: int
    """Samples at which all targets should be reached, or the cap; a guess that improves."""
    missing_db: float | None
    """The widest gap to a target when the floors were measured last; None before that."""
    image: "Image | None" = None
    """Picture of the samples so far, for display while it improves; None at most steps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """Picture of one camera, finished or intermediate."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance of at least 0."""
    samples: int | None = None
    """Samples per pixel; None where no path is sampled."""
    stated_error_db: float | None = None
    """Measured error as psnr_log_db; None where none was measured."""
    cpu_seconds: float | None
    """CPU seconds of this picture, where they were spent, without the scene's loading; None for a
    stored picture."""
    facts: Facts = field(default_factory=dict)
    layers_rgb: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """[R, R, 3] linear radiance of layers by name, whose sum is the picture; may be empty."""
    remark: str = ""
    """Remark beside the picture, such as how far its error may be trusted."""


OnProgress = Callable[[Sampling | Image], None]
"""Callback with progress and intermediate pictures; what it raises ends the picture."""


def ignore_progress(_: Sampling | Image) -> None:
    """Do nothing with the progress of a picture."""


class ReadyScene(Protocol):
    """Scene in a renderer, ready for any number of cameras."""

    @property
    def notes(self) -> Sequence[str]:
        """What the renderer cannot show of the scene, one sentence each."""

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of loading, without the start of a process."""

    @property
    def cpu_seconds(self) -> float | None:
        """CPU seconds of loading, where they were spent; None where they are unknown."""

    def render(self, camera: Camera, on_progress: OnProgress = ignore_progress) -> Image:
        """Return the picture of a camera.

        It raises Unrenderable where there is none of this scene, and TrilightError where the
        renderer is unusable.
        """


class Renderer(Protocol):
    """What makes pictures of one width; it starts processes and reads weights when first needed."""

    @property
    def name(self) -> str:
        """Name in rows, files and messages."""

    @property
    def resolution(self) -> int:
        """Width and height of its pictures in pixels."""

    @property
    def notes(self) -> Sequence[str]:
        """What all of its pictures lack, one sentence each."""

    @property
    def identity(self) -> Mapping[str, Any]:
        """Everything but scene and camera that decides a picture, as JSON values."""

    def load(self, scene: Scene, name: str) -> ReadyScene:
        """Load a scene, which messages call `name`.

        Args:
            scene: a scene that passes `Scene.check`.
            name: name of the scene.

        It raises Unrenderable where the scene cannot be rendered, and TrilightError where the
        renderer is unusable, or cannot make pictures of its width.
        """

    def close(self) -> None:
        """Release processes and memory; loaded scenes are of no use afterwards."""


def fingerprint(identity: Mapping[str, object]) -> str:
    """Return the SHA-256 of a renderer's identity, this version of Trilight included."""
    return sha256_hex(canonical_json({**identity, "trilight": metadata.version("trilight")}))
