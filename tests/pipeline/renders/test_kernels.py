"""What is paid once: loading a scene, compiling a kernel. (Memory: tests/extremes.)"""

import dataclasses
from collections.abc import Callable, Iterator

import drjit as dr
import numpy as np
import pytest

from pipeline.builds.named import named_build
from pipeline.generation.render_sample import RenderInput, ViewProgress, render_sample
from pipeline.renders import vector_tracer
from pipeline.renders.camera import PixelCamera
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.vector_tracer import VectorTracer
from storage.records.scene import Scene
from tests.pipeline.renders.guided_scenes import lit_by_a_mirror, mirrors
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import join, light, material, quad, sampled_like_scene, sphere

SETTINGS = RenderSettings(
    resolution=32, noise_floor_db=99.0, min_spp=8, max_spp=8, aux_spp=4, min_mean_radiance=0.0
)


@pytest.fixture
def history(llvm: None) -> Iterator[None]:
    """Dr.Jit keeps a list of the kernels that it launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield
    dr.kernel_history_clear()


_COPY_OPERATIONS = 9
"""What copies an array into Dr.Jit's memory (pipeline.renders.device_memory) counts 4 operations
and comes in a few variants, by the alignment of numpy's memory. The smallest other kernel, which
finds hits, counts 13, and the path tracer 2,000."""


def _launched() -> set[str]:
    """Return the hashes of the kernels launched since the last call, but for copies."""
    history = dr.kernel_history([dr.KernelType.JIT])
    return {entry["hash"] for entry in history if entry["operation_count"] > _COPY_OPERATIONS}


def _render(scene: Scene, settings: RenderSettings = SETTINGS) -> None:
    renderer = SceneRenderer(scene, settings)
    for view in range(scene.num_views):
        renderer.render_view(scene.c2w[view], float(scene.fov_deg[view]), seed=view)


def _smallest() -> Scene:
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    return join([floor, light([[-0.1, -0.1, 2], [0, 0.1, 2], [0.1, -0.1, 2]], 100.0)])


def _large() -> Scene:
    balls = [
        sphere([0.1 * i, 0, 0.5], 0.3, material(specular=0.9, roughness=0.1), rings=20)
        for i in range(3)
    ]
    lamps = [light([[-0.1, -0.1, 2 + i], [0, 0.1, 2], [0.1, -0.1, 2]], 10.0) for i in range(17)]
    return join([*balls, *lamps], fov_deg=100.0)


@pytest.mark.usefixtures("history")
def test_one_set_of_kernels_serves_every_scene_and_view() -> None:
    """Other triangles, materials, emitters, cameras, depths, sizes: nothing is compiled.

    A pass of another number of samples would have kernels of its own; there are three such numbers.
    """
    _render(_smallest())
    first = _launched()
    assert first
    for scene in (_large(), *(sampled_like_scene(np.random.default_rng(i)) for i in range(3))):
        _render(scene)
    _render(_large(), dataclasses.replace(SETTINGS, per_light=True))
    assert _launched() <= first
    _render(
        _large(), dataclasses.replace(SETTINGS, resolution=40, max_spp=16, max_depth=5, rr_depth=4)
    )
    assert _launched() <= first


@pytest.mark.usefixtures("history")
def test_guided_passes_have_one_more_set_of_kernels_for_every_scene() -> None:
    """That of a scene's table, of guided camera paths, and of the light paths that know of them."""
    tracer, seen = _guided(mirrors(), max_depth=10)
    tracer.radiance(seen, seed=0, spp=16)
    first = _launched()
    for depth, scene in enumerate((mirrors(0.05), lit_by_a_mirror(0.1))):
        tracer, seen = _guided(scene, max_depth=10 + depth)
        tracer.radiance(seen, seed=0, spp=16)
    assert _launched() <= first


def _guided(scene: Scene, *, max_depth: int) -> tuple[VectorTracer, PixelCamera]:
    tracer = VectorTracer(scene, max_depth=max_depth, rr_depth=2).with_guide()
    assert tracer._scene.guide is not None
    return tracer, camera_of(scene, 32)


@pytest.mark.usefixtures("history")
def test_the_count_of_kernels_can_tell() -> None:
    """A number that is part of the kernel, instead of data for it, makes another kernel."""
    for step in (1, 2):
        values = dr.arange(dr.llvm.Float, 77)
        for power in range(10):
            values = dr.fma(values, values, step + power)
        dr.eval(values)
    assert len(_launched()) == 2


def test_all_views_and_lights_share_one_load(llvm: None, monkeypatch: pytest.MonkeyPatch) -> None:
    loads = list[str]()
    load = vector_tracer._load

    monkeypatch.setattr(vector_tracer, "_load", _counted("load", load, loads))
    scene = sampled_like_scene(np.random.default_rng(3), num_views=2)
    scene = scene.with_provenance({"camera_attempts": [0] * 2})
    changes = {"renders.min_spp": 8, "renders.max_spp": 8, "renders.per_light": True}
    changes["scenes.num_views"] = 2
    settings = named_build("smoke", resolution=16, changes=changes)
    sample = render_sample(
        "000000000", RenderInput(scene=scene), settings, [], ViewProgress(None, 0)
    )
    assert len(sample.views) == 2
    assert len(loads) == 2  # what camera rays meet, and what all other rays meet


def test_pictures_come_back_only_where_something_is_decided(
    llvm: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pass that is read back makes a graphics card wait for us, and us for it."""
    reads = list[str]()
    for way in ("__array__", "__dlpack__", "numpy"):
        monkeypatch.setattr(dr.ArrayBase, way, _counted(way, getattr(dr.ArrayBase, way), reads))
    _render(_smallest(), dataclasses.replace(SETTINGS, min_spp=512, max_spp=512))
    # Both halves at the first look for black and at the floor, there with their squares; albedo,
    # normals and hits once.
    assert reads == ["__array__"] * (2 + 2 + 3 + 2)


def _counted(way: str, read: Callable[..., object], reads: list[str]) -> Callable[..., object]:
    def counted(*arguments: object, **named: object) -> object:
        reads.append(way)
        return read(*arguments, **named)

    return counted
