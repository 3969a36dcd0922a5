"""`PluginTracer`: Mitsuba's own `path` integrator over stock plugins and one texture of our own.

`VectorTracer` is compared with it. It runs on any variant of Mitsuba. Two things differ from
`VectorTracer`, neither beyond noise in smooth or mostly diffuse scenes: the Smith term of rough
lobes, and silhouettes of smooth low-poly mirrors, where Mitsuba turns a shading normal over that
faces away. Its sums of passes are in numpy's memory: those of the kernel are compared with them.
"""

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.tracer import Chosen, PixelCamera
from storage.records.scene import Scene
from tests.oracle.plugin_scene import plugin_feature_scene, plugin_scene


class HostSum:
    """A `DeviceSum` in numpy's memory, for a tracer that returns its passes there anyway."""

    def __init__(self, tracer: Any, camera: PixelCamera) -> None:
        self._tracer, self._camera = tracer, camera
        self._total = np.zeros((camera.resolution, camera.resolution, 3))
        self._numbers = np.zeros((3, camera.resolution, camera.resolution))

    def add(
        self, *, seed: int, spp: int, chosen: Chosen = None, light_seed: int | None = None
    ) -> None:
        means = self._tracer.radiance(self._camera, seed=seed, spp=spp, chosen=chosen)
        mean = means.astype(np.float64)
        self._total += spp * mean
        one = np.ones(mean.shape[:2]) if chosen is None else chosen
        self._numbers += [spp * np.square(mean.mean(axis=-1)), spp * one, one]

    def guide(self) -> None:
        """Do nothing: other tracers are not guided."""

    def read(self) -> list[NDArray[np.float64]]:
        return [self._total.copy(), *self._numbers.copy()]


_BLOCK_SIZE = 8
"""Pixels; fixed, because the random numbers of `scalar_rgb` belong to blocks."""

_NEAR_CLIP, _FAR_CLIP = 1e-4, 1e4
"""World units; wide enough to cut nothing of a scene around the unit cube."""


class PluginTracer:
    """A scene on any backend, whose sky no camera sees; see `VectorTracer` for its methods."""

    def __init__(self, scene: Scene, *, max_depth: int, rr_depth: int) -> None:
        self._scene = plugin_scene(scene)
        self._feature_scene = plugin_feature_scene(scene)
        self._path = _integrator(
            type="path", max_depth=max_depth, rr_depth=rr_depth, hide_emitters=True
        )
        self._depth = _integrator(type="aov", aovs="depth:depth")

    def radiance(self, camera: PixelCamera, *, seed: int, spp: int) -> NDArray[np.float32]:
        return _render(self._scene, self._path, camera, seed=seed, spp=spp)

    def hits(self, camera: PixelCamera) -> NDArray[np.bool_]:
        depth = _render(self._feature_scene, self._depth, camera, seed=0, spp=1, jitter=False)
        return depth[..., 0] > 0


def _integrator(**parameters: Any) -> Any:
    return mi.load_dict({"block_size": _BLOCK_SIZE, **parameters})


def _render(
    scene: Any, integrator: Any, camera: PixelCamera, *, seed: int, spp: int, jitter: bool = True
) -> NDArray[np.float32]:
    """Return the picture [R, R, channels]; without jitter, samples lie on a regular grid."""
    kind = "multijitter" if jitter else "stratified"
    sensor = stock_sensor(camera, {"type": kind, "sample_count": spp, "jitter": jitter})
    picture = mi.render(scene, sensor=sensor, integrator=integrator, seed=mi.UInt32(seed), spp=spp)
    return np.array(picture)


def stock_sensor(camera: PixelCamera, sampler: dict[str, Any]) -> Any:
    """Return Mitsuba's own camera for a view: box-filtered pixels, the sampler as its plugin."""
    # Mitsuba's cameras look along +Z with +X to the left.
    to_world = camera.c2w @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": camera.fov_deg,
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "near_clip": _NEAR_CLIP,
            "far_clip": _FAR_CLIP,
            "film": {
                "type": "hdrfilm",
                "width": camera.resolution,
                "height": camera.resolution,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": sampler,
        }
    )
