"""`Tracer`: what the renderer asks of `VectorTracer`, whose module imports Mitsuba.

The tests have another one, Mitsuba's stock path integrator (tests/oracle): an independent twin that
estimates the same integral.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.denoiser import Features
from storage.errors import Rejected
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelCamera:
    """A square picture's camera, as storage.conventions means it."""

    c2w: NDArray[np.float64]
    """[4, 4] camera to world; looks along -Z with +Y up."""
    fov_deg: float
    """Full field of view, equal in width and height."""
    resolution: int
    """Width and height in pixels."""

    def at_scale(self, factor: float) -> "PixelCamera":
        """Return the camera that sees the same of a scene that is so many times as large."""
        c2w = self.c2w.copy()
        c2w[:3, 3] *= factor
        return replace(self, c2w=c2w)


def pixel_camera(c2w: ArrayLike, fov_deg: float, resolution: int) -> PixelCamera:
    """Return the camera of a pose and an angle of any number type."""
    pose = np.asarray(c2w, np.float64)
    return PixelCamera(c2w=pose, fov_deg=float(fov_deg), resolution=resolution)


Chosen = NDArray[np.bool_] | None
"""[R, R] the pixels of a pass, one at least; None means all of them."""


class PassSum(Protocol):
    """The growing sum of the passes of one view, in the memory where they are traced."""

    def add(
        self, *, seed: int, spp: int, chosen: Chosen = None, light_seed: int | None = None
    ) -> None:
        """Add all samples of one pass: `Tracer.radiance` times `spp`.

        It may return before they are traced. With `light_seed` its light paths have that seed.
        """

    def guide(self) -> None:
        """Let the passes from now on be guided (pipeline.renders.guide_table), if they can be.

        Their expected value stays the same. The first call for a scene learns it.
        """

    def read(self) -> NDArray[np.float64]:
        """Return the sum over all samples of each part (`Tracer.apart`), [Q, R, R, 3]; else Q = 1.

        It is not finite where any sample was not. It waits until they are traced, and equals the
        sum in float64 of the passes, one by one.
        """

    def read_squares(self) -> NDArray[np.float64]:
        """Return the sum over the passes of samples times squared grey mean, [R, R].

        Grey is the mean of the three channels of all parts together. With `read` it gives the
        spread between passes.
        """


class Tracer(Protocol):
    """One loaded scene. Emitters are hidden from camera rays in everything that it returns."""

    def only_light(self, row: int | None) -> "Tracer":
        """Return the same loaded scene in which only the emitter `objects[row]` is switched on.

        The others stay where they are, black, and an environment is off; None leaves only that on.
        Equal seeds give equal camera rays in both.

        Raises:
            Rejected: "unlit_scene" where it has no area.
        """

    def split_lights(self, *, bounces: bool, lobes: bool) -> "Tracer":
        """Return the same loaded scene, whose sums of passes are by part.

        Args:
            bounces: keep direct and indirect light apart.
            lobes: keep the diffuse and the specular lobe of the visible surface apart.
        """

    def for_views(self, cameras: Sequence[PixelCamera]) -> "Tracer":
        """Return the same loaded scene, which traces light paths of one seed once for all views.

        Args:
            cameras: of the views, in the order in which they will be asked for.
        """

    def radiance(
        self, camera: PixelCamera, *, seed: int, spp: int, chosen: Chosen = None
    ) -> NDArray[np.float32]:
        """Return the mean of one pass of samples, linear radiance [R, R, 3]; 0 if not chosen.

        Equal arguments give equal bits, whatever the number of threads. With other pixels chosen,
        a pixel's samples may be others.

        Args:
            camera: the view.
            seed: 31 bits; passes with different seeds are independent.
            spp: samples per pixel, a square of a power of two.
            chosen: the pixels that are wanted. A tracer may trace the others too.
        """

    def pass_sum(self, camera: PixelCamera) -> PassSum: ...

    def features(self, camera: PixelCamera, *, spp: int) -> Features:
        """Return the albedo and normal pictures, of `spp` evenly spread rays in each pixel."""

    def hits(self, camera: PixelCamera) -> NDArray[np.bool_]:
        """Return whether the ray through each pixel's centre hits a surface, [R, R]."""


def split_triangles(scene: Scene) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the triangle rows of surfaces and those of emitters."""
    emits = scene.triangle_emits
    return np.flatnonzero(~emits), np.flatnonzero(emits)


SIZES_AS_THEY_ARE_M = (0.1, 10.0)
"""Scenes between these sizes are traced as they are; all presets' scenes are."""


def load_tracer(scene: Scene, *, max_depth: int, rr_depth: int) -> Tracer:
    """Return the tracer of a scene; call after `activate`.

    Textures of one value are the constants that they are: they cost nothing.

    Raises:
        Rejected: "unlit_scene"; "no_surfaces" where all triangles emit: pictures would be black.
    """
    from pipeline.renders.vector_tracer import VectorTracer  # imports mitsuba

    if scene.triangle_emits.all():
        raise Rejected("no_surfaces", f"all {scene.num_triangles} triangles are emitters")
    scale = choose_tracing_scale(scene)
    scene = without_constant_textures(scene)
    if scale != 1:
        scene = dataclasses.replace(
            scene, vertex_positions=scene.vertex_positions * np.float32(scale)
        )
    return VectorTracer(scene, max_depth=max_depth, rr_depth=rr_depth, scale=scale)


def choose_tracing_scale(scene: Scene) -> float:
    """Return what lengths are multiplied by for tracing: 1, or a power of two (exact in floats).

    Mitsuba moves the origins of rays off surfaces by lengths that suit a scene of a metre. In a
    scene of a millimetre they would pass through walls, and the stated error would not show it.
    Radiance knows no length, so a tiny or huge scene is traced at the size of about a metre. Size
    is the diagonal of what is seen: emitters and cameras may be far away.
    """
    surfaces, _ = split_triangles(scene)
    corners = scene.vertex_positions[np.unique(scene.faces[surfaces])].astype(np.float64)
    size = float(np.linalg.norm(np.ptp(corners, axis=0))) if len(corners) else 0.0
    smallest, largest = SIZES_AS_THEY_ARE_M
    return 1.0 if size == 0 or smallest <= size <= largest else 2.0 ** -round(math.log2(size))
