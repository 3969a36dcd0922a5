"""The kernel's BRDF by itself: energy, sign, reciprocity, and samples as their density says."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import ggx
from pipeline.renders.ggx import AlbedoLookup, KernelLobes
from storage.optics.bsdf import bsdf_lobes
from storage.optics.multiscatter import directional_albedo, scattered_again
from tests.pipeline.renders.scene_kit import material
from tests.storage.optics.test_multiscatter import stretched

pytestmark = pytest.mark.usefixtures("llvm")


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
            directions = [
                mi.Vector3f(mi.TensorXf(d.astype(np.float32))) for d in (wi, wo, geometric)
            ]
            result = ggx.evaluate_bsdf(seen_at(lobes, directions[0]), *directions)
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
