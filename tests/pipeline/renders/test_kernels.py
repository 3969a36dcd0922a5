"""What is paid once: loading, compiling, recording and reading back. (Memory: tests/extremes.)"""

import dataclasses
import gc
import itertools
import weakref
from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.generation.render_sample import RenderInput, ViewProgress, render_sample
from pipeline.presets.registry import preset_settings
from pipeline.renders import kernel_scene
from pipeline.renders.device_memory import KernelInputs, read_back, record_launches
from pipeline.renders.device_pictures import DevicePictures
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.tracer import Tracer, load_tracer
from pipeline.renders.vector_tracer import VectorTracer
from pipeline.renders.view_pictures import MeasuredLook
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.pipeline.renders.sampling import camera_of, render_view
from tests.pipeline.renders.scene_kit import (
    join,
    light,
    lit_by_a_mirror,
    material,
    mirrors,
    quad,
    sampled_like_scene,
    sphere,
)
from tests.pipeline.renders.test_renderer import lit_scene

pytestmark = pytest.mark.usefixtures("llvm")

PX = 32


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


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The bytes of each array that is read back from the device."""
    sizes = list[int]()
    for way in ("__array__", "numpy"):
        read = getattr(dr.ArrayBase, way)

        def counted(array: Any, *rest: Any, _read: Any = read, **named: Any) -> Any:
            values = _read(array, *rest, **named)
            sizes.append(values.nbytes)
            return values

        monkeypatch.setattr(dr.ArrayBase, way, counted)
    return sizes


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
    launched = []
    for depth, scene in enumerate((mirrors(), mirrors(0.05), lit_by_a_mirror(0.1))):
        tracer = VectorTracer(scene, max_depth=10 + depth, rr_depth=2).with_guide()
        assert tracer._scene.guide is not None
        tracer.radiance(camera_of(scene, PX), seed=0, spp=16)
        launched.append(_launched())
    assert launched[0] and launched[1] | launched[2] <= launched[0]


def test_all_views_and_lights_share_one_load(monkeypatch: pytest.MonkeyPatch) -> None:
    loads = list[Scene]()
    load = kernel_scene.build_mitsuba_scene

    def counted(scene: Scene, *rest: Any, **named: Any) -> Any:
        loads.append(scene)
        return load(scene, *rest, **named)

    monkeypatch.setattr(kernel_scene, "build_mitsuba_scene", counted)
    scene = sampled_like_scene(np.random.default_rng(3), num_views=2)
    scene = scene.with_provenance({"camera_attempts": [0] * 2})
    changes = {"renders.min_spp": 8, "renders.max_spp": 8, "renders.per_light": True}
    changes["scenes.num_views"] = 2
    settings = preset_settings("smoke", resolution=16, changes=changes)
    sample = render_sample(
        "000000000", RenderInput(scene=scene), settings, [], ViewProgress(None, 0)
    )
    assert len(sample.views) == 2
    assert len(loads) == 2  # what camera rays meet, and what all other rays meet


def test_pictures_come_back_only_where_something_is_decided(reads: list[int]) -> None:
    """A pass that is read back makes a graphics card wait for us, and us for it."""
    _render(_smallest(), dataclasses.replace(SETTINGS, min_spp=512, max_spp=512))
    # Both halves at the first look for black and at the floor, there with their squares; albedo,
    # normals and hits once.
    assert len(reads) == 2 + 2 + 3 + 2


ADAPTIVE = dataclasses.replace(SETTINGS, min_spp=32, max_spp=512, aux_spp=16)
"""To 512 samples: 10 passes and more decide which pixels are kept, and tiles are chosen."""


def test_little_is_read_back_by_device_arithmetic(
    reads: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once at a look, and little; the picture once, and once what shows anything."""
    num_looks, look = 0, DevicePictures.look

    def counted_look(self: DevicePictures, quality: Filtered) -> MeasuredLook:
        nonlocal num_looks
        num_looks += 1
        return look(self, quality)

    monkeypatch.setattr(DevicePictures, "look", counted_look)
    settings = dataclasses.replace(ADAPTIVE, resolution=64, max_spp=256, arithmetic="device")
    render_view(sampled_like_scene(np.random.default_rng(5), num_views=1), settings)
    picture_bytes = 4 * 3 * 64**2
    small = [size for size in reads if size < picture_bytes / 4]
    assert num_looks > 2
    assert reads.count(picture_bytes) == 1 and len(reads) == len(small) + 1
    # the mean of the first passes, what shows anything, and each look
    assert len(small) == 2 + num_looks


@for_each(
    "changes",
    [
        {},
        {"denoiser": "off", "max_spp": 256},
        {"per_light": True, "max_spp": 256},
        {"split": True, "split_lobes": True},
        {"per_light": True, "split": True, "max_spp": 128},
    ],
)
def test_device_arithmetic_gives_the_views_of_numpy_but_for_roundings(
    changes: dict[str, Any],
) -> None:
    settings = dataclasses.replace(ADAPTIVE, **changes)
    numpys = render_view(lit_scene(), settings, 3)
    ours = render_view(lit_scene(), dataclasses.replace(settings, arithmetic="device"), 3)
    assert (ours.spp, ours.at_cap) == (numpys.spp, numpys.at_cap)
    np.testing.assert_array_equal(ours.hits, numpys.hits)
    # float32 roundings, and those to half floats where pictures are apart: 2^-11 of each
    tolerance = 2 * 2**-11 if changes.get("per_light") or changes.get("split") else 1e-5
    np.testing.assert_allclose(ours.radiance_rgb, numpys.radiance_rgb, rtol=tolerance, atol=1e-6)
    np.testing.assert_allclose(_floors_db(ours), _floors_db(numpys), rtol=0, atol=0.01)


def _floors_db(view: RenderedView) -> list[float]:
    of_picture = view.noise_floor_db, view.noise_floor_linear_db, view.object_noise_floor_db
    floors = [*(view.part_floors or {}).values(), *(view.light_floors or ())]
    return [*of_picture, *(db for floor in floors for db in dataclasses.astuple(floor))]


def _sums(tracer: Tracer, scene: Scene, first_seed: int) -> list[NDArray]:
    """Return the sums of passes of other seeds, samples and pixels, some of them guided."""
    assert isinstance(tracer, VectorTracer)
    total, rng = tracer.pass_sum(camera_of(scene, PX)), np.random.default_rng(first_seed)
    for number, (spp, fraction) in enumerate(itertools.product((4, 16, 64), (1, 0.5, 0.1))):
        chosen = None if fraction == 1 else rng.random((PX, PX)) < fraction
        if number == 6:
            total.guide()
        total.add(seed=first_seed + number, spp=spp, chosen=chosen)
    return [read_back(sums) for sums in total.sums]


def test_replayed_passes_are_traced_ones_in_every_bit() -> None:
    """Whichever scene, camera, depth, seed and pixels a recording was made with."""
    scenes = [mirrors(), lit_by_a_mirror(0.1), sampled_like_scene(np.random.default_rng(3))]

    def sums() -> list[list[NDArray]]:
        return [
            _sums(load_tracer(scene, max_depth=5 + repeat, rr_depth=2), scene, 100 * repeat)
            for repeat, scene in itertools.product(range(2), scenes)
        ]

    replayed = sums()
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        traced = sums()
    for ours, theirs in zip(replayed, traced, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_scene_that_was_recorded_is_not_kept() -> None:
    scene = sampled_like_scene(np.random.default_rng(1))
    tracer = load_tracer(scene, max_depth=4, rr_depth=2)
    tracer.radiance(camera_of(scene, PX), seed=0, spp=4)
    table = weakref.ref(vars(vars(tracer)["_scene"])["table"])
    del tracer
    assert table() is None


def test_old_scenes_are_not_freed_while_a_call_is_recorded() -> None:
    """Dr.Jit would end the process."""
    old = load_tracer(mirrors(), max_depth=4, rr_depth=2)
    vars(old)["itself"] = old
    del old

    def double(_: Any, values: Any) -> Any:
        if gc.isenabled():
            gc.collect()
        return 2 * values

    doubled = record_launches(double)(KernelInputs(), dr.opaque(mi.Float, 1, 3))
    np.testing.assert_array_equal(doubled, 2)
