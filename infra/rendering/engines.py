"""The two ways to a picture behind one face: path tracing, and a trained network."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from storage.conventions import HALF_FLOAT_MAX
from storage.records.material import PUBLISHED_COLUMNS, unread_columns
from storage.records.scene import Scene

if TYPE_CHECKING:
    from model.neural_renderer import NeuralRenderer
    from pipeline.making.render_scene import PathTracer

Fact = str | int | float


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendered:
    """A picture as an engine gives it."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance that half floats can hold."""
    facts: Mapping[str, Fact]
    """What there is to say of it, by name; stands in the picture's header."""


class Engine(Protocol):
    """Renders one scene after another."""

    name: str
    """As the user calls it."""
    identity: Mapping[str, Any]
    """All that decides a picture beside scene and camera, as JSON values."""

    def open(self, scene: Scene, name: str) -> tuple[str, ...]:
        """Take the scene that is rendered from now on; return what a person should know."""

    def render(self, c2w: NDArray[np.float32], fov_deg: float, name: str) -> Rendered:
        """Return the picture of one camera; raises TrilightError, with `name`, if there is none."""

    def close(self) -> None:
        """Let go of what it holds."""


class MitsubaEngine:
    """Path tracing to a measured noise floor."""

    name = "mitsuba"

    def __init__(self, tracer: "PathTracer") -> None:
        self._tracer = tracer
        self.identity = tracer.identity

    def open(self, scene: Scene, name: str) -> tuple[str, ...]:
        self._tracer.open(scene, name)
        unread = unread_columns(scene.materials, PUBLISHED_COLUMNS)
        return (f"{name}: the path tracer does not read {', '.join(unread)}",) if unread else ()

    def render(self, c2w: NDArray[np.float32], fov_deg: float, name: str) -> Rendered:
        view = self._tracer.render(c2w, fov_deg, name)
        facts: dict[str, Fact] = {
            "spp": view.spp,
            "noise_floor_db": round(view.noise_floor_db, 3),
            "noise_floor_linear_db": round(view.noise_floor_linear_db, 3),
            "object_noise_floor_db": round(view.object_noise_floor_db, 3),
            "at_cap": int(view.at_cap),
        }
        return Rendered(radiance_rgb=view.radiance_rgb, facts=facts)

    def close(self) -> None:
        self._tracer.close()


class NeuralEngine:
    """A trained network."""

    name = "neural"

    def __init__(
        self,
        renderer: "NeuralRenderer",
        *,
        checkpoint: str,
        precision: str,
        resolution: int,
        lights_per_pass: int,
        skip_empty_bundles: bool,
    ) -> None:
        """Take a network.

        Args:
            renderer: the network.
            checkpoint: where it came from; only its last part is published.
            precision: in which it was loaded (model.precision).
            resolution: width of pictures.
            lights_per_pass: most emitting triangles of a group (model.light_groups).
            skip_empty_bundles: whether what no triangle reaches stays black (model.empty_bundles).

        Raises:
            TrilightError: the resolution is none for this network.
        """
        import torch

        renderer.require_resolution(resolution)
        self._renderer = renderer
        self._resolution, self._lights_per_pass = resolution, lights_per_pass
        self._skip_empty_bundles = skip_empty_bundles
        self.identity: Mapping[str, Any] = {
            "checkpoint": Path(checkpoint).name,
            "network_sha256": renderer.digest,
            "settings": {
                "precision": precision,
                "resolution": resolution,
                "lights_per_pass": lights_per_pass,
                "skip_empty_bundles": skip_empty_bundles,
            },
            "environment": {"torch": torch.__version__, "device": renderer.device.type},
        }

    def open(self, scene: Scene, name: str) -> tuple[str, ...]:
        self._prepared = self._renderer.prepare(scene, lights_per_pass=self._lights_per_pass)
        of_scene = tuple(f"{name}: {note}" for note in self._prepared.notes)
        return of_scene + self._renderer.resolution_notes(self._resolution)

    def render(self, c2w: NDArray[np.float32], fov_deg: float, name: str) -> Rendered:
        picture = self._renderer.view(
            self._prepared,
            c2w,
            fov_deg,
            self._resolution,
            skip_empty_bundles=self._skip_empty_bundles,
        )
        too_bright = int((picture > HALF_FLOAT_MAX).any(axis=-1).sum())
        facts: dict[str, Fact] = {
            "passes": len(self._prepared.groups),
            "clipped_pixels": too_bright,  # a network may say anything; files end at 65504
        }
        return Rendered(radiance_rgb=np.minimum(picture, HALF_FLOAT_MAX), facts=facts)

    def close(self) -> None:
        """Nothing is held that must be ended."""
