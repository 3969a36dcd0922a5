"""The kernel's BRDF by itself, and what is paid once: compiling and reading back."""

import dataclasses
import gc
import itertools
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import ggx
from pipeline.renders.device_memory import KernelInputs, read_back, record_launches
from pipeline.renders.device_pictures import DevicePictures
from pipeline.renders.ggx import AlbedoLookup, KernelLobes
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.tracer import load_tracer
from pipeline.renders.vector_tracer import VectorTracer
from storage.optics import bsdf_lobes, directional_albedo, scattered_again
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.pipeline.renders.sampling import camera_of, render_view, view_settings
from tests.pipeline.renders.scene_kit import (
    join,
    lamp_over_floor,
    light,
    lit_by_a_mirror,
    material,
    mirrors,
    sampled_like_scene,
    sphere,
)
from tests.pipeline.renders.test_renderer import lit_scene
from tests.storage.test_optics import stretched

pytestmark = pytest.mark.usefixtures("llvm")

PX = 32

SETTINGS = view_settings(8, aux_spp=4, min_mean_radiance=0.0)


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
    _render(lamp_over_floor(100.0))
    first = _launched()
    assert first
    for scene in (_large(), *(sampled_like_scene(np.random.default_rng(i)) for i in range(3))):
        _render(scene)
    _render(_large(), dataclasses.replace(SETTINGS, per_light=True))
    assert _launched() <= first
    other = dataclasses.replace(SETTINGS, resolution=40, max_spp=16, max_depth=5, rr_depth=4)
    _render(_large(), other)
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


def test_pictures_come_back_only_where_something_is_decided(reads: list[int]) -> None:
    """A pass that is read back makes a graphics card wait for us, and us for it."""
    _render(lamp_over_floor(100.0), dataclasses.replace(SETTINGS, min_spp=512, max_spp=512))
    # Both halves, of four arrays, at the first look for black and at the floor; albedo, normals and
    # hits once.
    assert len(reads) == 2 * 4 + 2 * 4 + 3


ADAPTIVE = dataclasses.replace(SETTINGS, min_spp=32, max_spp=512, aux_spp=16)
"""To 512 samples: 10 passes and more decide which pixels are kept, and tiles are chosen."""


def test_little_is_read_back_by_device_arithmetic(
    reads: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once at a look, and little; the picture once, and once what shows anything."""
    look = create_autospec(DevicePictures.look, side_effect=DevicePictures.look)
    monkeypatch.setattr(DevicePictures, "look", look)
    settings = dataclasses.replace(ADAPTIVE, resolution=64, max_spp=256, arithmetic="device")
    render_view(sampled_like_scene(np.random.default_rng(5), num_views=1), settings)
    picture_bytes = 4 * 3 * 64**2
    small = [size for size in reads if size < picture_bytes / 4]
    assert look.call_count > 2
    assert reads.count(picture_bytes) == 1 and len(reads) == len(small) + 1
    # the mean of the first passes, what shows anything, and each look
    assert len(small) == 2 + look.call_count


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


def _sums(tracer: VectorTracer, scene: Scene, first_seed: int) -> list[NDArray]:
    """Return the sums of passes of other seeds, samples and pixels, some of them guided."""
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

    def double(values: Any) -> Any:
        if gc.isenabled():
            gc.collect()
        return 2 * values

    doubled = record_launches(double)(KernelInputs(), dr.opaque(mi.Float, 1, 3))
    np.testing.assert_array_equal(doubled, 2)


UP = (0.0, 0.0, 1.0)


def kernel_lobes(*, diffuse: Any = 0.0, specular: Any = 0.0, roughness: float) -> KernelLobes:
    """Return one material as the kernel has it."""
    row = material(diffuse=diffuse, specular=specular, roughness=roughness)
    lobes = bsdf_lobes(row[None].astype(np.float32))
    again = scattered_again(lobes.specular, lobes.alpha, "correlated")
    return KernelLobes(
        diffuse=mi.Color3f(*lobes.diffuse[0].tolist()),
        specular=mi.Color3f(*lobes.specular[0].tolist()),
        alpha=mi.Float(lobes.alpha[0]),
        weight=mi.Float(lobes.weight[0]),
        multiscatter=mi.Color3f(*again[0].tolist()),
    )


def seen_at(lobes: KernelLobes, wi: Any) -> KernelLobes:
    """Return the lobes as a path vertex has them."""
    return ggx.seen_from(lobes, wi, AlbedoLookup()(wi.z, lobes.alpha, mi.Bool(True)))


def direction(cosine: float) -> Any:
    return mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0.0, cosine)


def test_the_lobe_returns_all_light_from_a_hundred_directions() -> None:
    """By its own samples: the mean of f cos / density, from the normal to a cosine of 1e-3."""
    side, cosines = 96, np.geomspace(1e-3, 1, 100)
    count = side * side
    lanes = np.repeat(cosines, count)
    wi = mi.Vector3f(mi.Float(np.sqrt(1 - lanes**2)), 0, mi.Float(lanes))
    middles = (np.arange(side) + 0.5) / side
    grid = [np.repeat(middles, side), np.tile(middles, side)]
    u = mi.Point2f(*(mi.Float(np.tile(axis, len(cosines))) for axis in grid))
    for roughness in (0.01, 0.03, 0.1, 0.3, 0.5, 0.7, 0.85, 1.0):
        lobes = seen_at(kernel_lobes(specular=1.0, roughness=roughness), wi)
        wo = ggx.sample(lobes, wi, mi.Float(0), u)
        reflected, pdf = ggx.evaluate_bsdf(lobes, wi, wo, mi.Vector3f(*UP))
        returned = dr.block_sum(dr.select(pdf > 0, reflected.x / pdf, 0), count) / count
        # Measured: up to 0.37 %, of which the table has 0.25.
        assert abs(np.array(returned) - 1).max() < 0.005, roughness


def test_nothing_is_negative_and_nothing_is_nan() -> None:
    rng = np.random.default_rng(0)
    for roughness in (0.0, 0.01, 0.1, 1.0):
        wi, wo, geometric = (_unit(rng.normal(size=(3, 50_000))) for _ in range(3))
        wi[:, :10_000] = _unit(wi[:, :10_000] * np.array([[1], [1], [1e-5]]))
        wo[:, 5000:20_000] = wi[:, 5000:20_000] * np.array([[-1], [-1], [1]])
        for diffuse, specular in ((0.0, 1.0), (0.0, 0.0), (1.0, 0.0), (0.3, [0.7, 0.1, 0.0])):
            lobes = kernel_lobes(diffuse=diffuse, specular=specular, roughness=roughness)
            each = [mi.Vector3f(mi.TensorXf(d.astype(np.float32))) for d in (wi, wo, geometric)]
            result = ggx.evaluate_bsdf(seen_at(lobes, each[0]), *each)
            for values in result:
                dr.eval(values)
                assert np.isfinite(np.array(values)).all()
                assert (np.array(values) >= 0).all()


def test_what_is_reciprocal_and_what_is_not() -> None:
    """Both lobes are before the scale; it breaks the law, by the ratio of the two albedos."""
    cosines = np.array([1.0, 0.7, 0.3, 0.1])
    up = mi.Vector3f(*UP)
    for roughness in (0.1, 0.5, 1.0):
        alpha = np.array(roughness**2)
        albedo = directional_albedo(stretched(cosines, alpha), alpha, "correlated")
        for a in range(len(cosines)):
            for b in range(a):
                wi, wo = direction(float(cosines[a])), mi.Vector3f(direction(float(cosines[b])))
                wo = mi.Vector3f(-0.6 * wo.x, 0.8 * wo.x, wo.z)
                single = kernel_lobes(diffuse=0.3, specular=0.7, roughness=roughness)
                there = ggx.evaluate_bsdf(single, wi, wo, up)[0].x / wo.z
                back = ggx.evaluate_bsdf(single, wo, wi, up)[0].x / wi.z
                # float32
                assert float(there[0]) == pytest.approx(float(back[0]), rel=1e-4)
                white = kernel_lobes(specular=1.0, roughness=roughness)
                there = ggx.evaluate_bsdf(seen_at(white, wi), wi, wo, up)[0].x / wo.z
                back = ggx.evaluate_bsdf(seen_at(white, wo), wo, wi, up)[0].x / wi.z
                # The table is exact to 0.25 % for each of the two.
                assert float(there[0] / back[0]) == pytest.approx(albedo[b] / albedo[a], rel=6e-3)


def _unit(vectors: NDArray) -> NDArray:
    unit: NDArray = vectors / np.linalg.norm(vectors, axis=0)
    return unit


def test_the_way_back_has_the_density_that_a_path_from_there_draws() -> None:
    """On either side of a triangle that leans against the shading normal."""
    rng = np.random.default_rng(3)
    wi, wo, geometric = (
        dr.normalize(mi.Vector3f(rng.normal(size=(3, 4000)) + up * np.array([[0], [0], [1]])))
        for up in (0.5, 1.5, 1.0)
    )
    geometric *= dr.mulsign(mi.Float(1), dr.dot(geometric, wi))  # faces the viewer
    turn = dr.mulsign(mi.Float(1), dr.dot(geometric, wo))
    mirror = mi.Vector3f(1, 1, turn)
    there, back = wo * mirror, wi * mirror
    normal = geometric * mirror * turn
    for roughness in (0.1, 0.5, 1.0):
        lobes = kernel_lobes(diffuse=0.3, specular=0.5, roughness=roughness)
        expected = ggx.evaluate_bsdf(seen_at(lobes, there), there, back, normal)[1]
        found = ggx.reverse_pdf(seen_at(lobes, wi), wi, wo, geometric)
        useful = np.array(ggx.evaluate_bsdf(seen_at(lobes, wi), wi, wo, geometric)[1]) > 0
        sides = np.array(turn)[useful]
        assert (sides > 0).sum() > 100 and (sides < 0).sum() > 100
        # The same formula in another order, in float32.
        np.testing.assert_allclose(np.array(found)[useful], np.array(expected)[useful], rtol=1e-4)


SAMPLES = 300_000
SIGNIFICANCE = 0.01
"""Chance that any of all cases is rejected although it is right; the seeds are fixed."""

MIRRORS = [(0.01, 0.5), (0.03, 0.02), (0.03, 0.95), (0.1, 0.15), (0.3, 0.5), (1.0, 0.02),
           (1.0, 0.95)]  # fmt: skip
"""Roughness and cosine. Not 0.01 at 0.02: wi + wo is 0.04 long there, so that float32 rounds the
half vector by 2 % of the lobe's width, and the histogram shows the rounding."""

MIXTURES = [(0.5, 0.15), (0.7, 0.5), (1.0, 0.95)]
CASES = len(MIRRORS) + len(MIXTURES)


class FacetDomain:
    """Directions by the facet that mirrors `wi` there: psi with tan(facet) = alpha tan(psi), and
    azimuth. However narrow the lobe is, it is wide here. Interface of mi.chi2's domains."""

    def __init__(self, wi: Any, alpha: float) -> None:
        self.wi, self.alpha = wi, alpha

    def bounds(self) -> Any:
        low, high = mi.ScalarPoint2f(0, -np.pi), mi.ScalarPoint2f(np.pi / 2, np.pi)
        return mi.ScalarBoundingBox2f(low, high)

    def aspect(self) -> float:
        return 0.25

    def map_forward(self, p: Any) -> Any:
        half = self._facet(p)
        return half * (2 * dr.dot(self.wi, half)) - self.wi

    def map_backward(self, wo: Any) -> Any:
        half = dr.normalize(self.wi + wo)
        slope = dr.sqrt(half.x * half.x + half.y * half.y) / half.z
        return mi.Vector2f(dr.atan(slope / self.alpha), dr.atan2(half.y, half.x))

    def area(self, wo: Any) -> Any:
        """Return the solid angle of `wo` per area of the domain."""
        half = dr.normalize(self.wi + wo)
        psi = self.map_backward(wo).x
        turned = self.alpha * dr.square(half.z / dr.cos(psi))
        sine = dr.sqrt(half.x * half.x + half.y * half.y)
        return 4 * dr.dot(self.wi, half) * sine * turned

    def _facet(self, p: Any) -> Any:
        slope = self.alpha * dr.tan(p.x)
        sine, cosine = dr.sincos(p.y)
        return dr.normalize(mi.Vector3f(slope * cosine, slope * sine, 1))


def _chi_square(
    lobes: KernelLobes,
    wi: Any,
    domain: Any,
    area: Callable[[Any], Any],
    geometric: tuple[float, float, float] = UP,
    claimed: KernelLobes | None = None,
) -> bool:
    """Return whether samples of `lobes` may follow the density of `claimed`."""
    normal = mi.Vector3f(*geometric)

    def pdf(wo: Any) -> Any:
        return ggx.evaluate_bsdf(seen_at(claimed or lobes, wi), wi, wo, normal)[1]

    def sample(u: Any) -> tuple[Any, Any]:
        wo = ggx.sample(seen_at(lobes, wi), wi, u[0], mi.Point2f(u[1], u[2]))
        return wo, dr.select(pdf(wo) > 0, mi.Float(1), 0)

    test = mi.chi2.ChiSquareTest(
        domain=domain,
        sample_func=sample,
        pdf_func=lambda wo: pdf(wo) * area(wo),
        sample_dim=3,
        sample_count=SAMPLES,
        res=101,
        ires=16,
    )
    accepted: bool = test.run(significance_level=SIGNIFICANCE, test_count=CASES, quiet=True)
    return accepted


def test_directions_follow_their_density(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Visible normals alone, and the mixture with a shading normal that leans away, too."""
    monkeypatch.chdir(tmp_path)  # Mitsuba writes what it rejects into the working folder
    for roughness, cosine in MIRRORS:
        lobes, wi = kernel_lobes(specular=[0.9, 0.5, 0.2], roughness=roughness), direction(cosine)
        domain = FacetDomain(wi, max(roughness**2, 1e-4))
        assert _chi_square(lobes, wi, domain, domain.area), (roughness, cosine)
    for roughness, cosine in MIXTURES:
        lobes = kernel_lobes(diffuse=[0.1, 0.4, 0.2], specular=0.5, roughness=roughness)
        sphere, leaning = mi.chi2.SphericalDomain(), (-0.6, 0.0, 0.8)
        assert _chi_square(lobes, direction(cosine), sphere, lambda _: 1.0, leaning), roughness
    # The test notices a density of five percent more roughness.
    wi, claimed = direction(0.5), kernel_lobes(specular=0.5, roughness=0.3 * 1.05)
    domain, lobes = FacetDomain(wi, 0.09), kernel_lobes(specular=0.5, roughness=0.3)
    assert not _chi_square(lobes, wi, domain, domain.area, claimed=claimed)
