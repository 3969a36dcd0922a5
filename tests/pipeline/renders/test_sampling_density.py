"""What the kernel samples is distributed as its density says: Mitsuba's chi-square test."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.renders import ggx
from pipeline.renders.ggx import KernelLobes
from tests.pipeline.renders.kernel_lobes import UP, direction, kernel_lobes, seen_at

pytestmark = pytest.mark.usefixtures("llvm")

SAMPLES = 300_000
SIGNIFICANCE = 0.01
"""Chance that any of all cases is rejected although it is right; the seeds are fixed."""

MIRRORS = [(0.01, 0.5), (0.03, 0.02), (0.03, 0.95), (0.1, 0.15), (0.3, 0.5), (1.0, 0.02),
           (1.0, 0.95)]  # fmt: skip
"""Roughness and cosine. Not 0.01 at 0.02: wi + wo is 0.04 long there, so that float32 rounds the
half vector by 2 % of the lobe's width, and the histogram shows the rounding."""

MIXTURES = [(0.5, 0.15), (0.7, 0.5), (1.0, 0.95)]
CASES = len(MIRRORS) + len(MIXTURES)


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mitsuba writes what it rejects into the working folder."""
    monkeypatch.chdir(tmp_path)


class FacetDomain:
    """Directions by the facet that mirrors `wi` there: psi with tan(facet) = alpha tan(psi), and
    azimuth. However narrow the lobe is, it is wide here. Interface of mi.chi2's domains."""

    def __init__(self, wi: Any, alpha: float) -> None:
        self.wi, self.alpha = wi, alpha

    def bounds(self) -> Any:
        import mitsuba as mi

        low, high = mi.ScalarPoint2f(0, -np.pi), mi.ScalarPoint2f(np.pi / 2, np.pi)
        return mi.ScalarBoundingBox2f(low, high)

    def aspect(self) -> float:
        return 0.25

    def map_forward(self, p: Any) -> Any:
        import drjit as dr

        half = self._facet(p)
        return half * (2 * dr.dot(self.wi, half)) - self.wi

    def map_backward(self, wo: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        half = dr.normalize(self.wi + wo)
        slope = dr.sqrt(half.x * half.x + half.y * half.y) / half.z
        return mi.Vector2f(dr.atan(slope / self.alpha), dr.atan2(half.y, half.x))

    def area(self, wo: Any) -> Any:
        """Return the solid angle of `wo` per area of the domain."""
        import drjit as dr

        half = dr.normalize(self.wi + wo)
        psi = self.map_backward(wo).x
        turned = self.alpha * dr.square(half.z / dr.cos(psi))
        sine = dr.sqrt(half.x * half.x + half.y * half.y)
        return 4 * dr.dot(self.wi, half) * sine * turned

    def _facet(self, p: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

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
    import drjit as dr
    import mitsuba as mi

    normal = mi.Vector3f(*geometric)

    def density(wo: Any) -> Any:
        return ggx.evaluate(seen_at(claimed or lobes, wi), wi, wo, normal)[1]

    def sample(u: Any) -> tuple[Any, Any]:
        wo = ggx.sample(seen_at(lobes, wi), wi, u[0], mi.Point2f(u[1], u[2]))
        return wo, dr.select(density(wo) > 0, mi.Float(1), 0)

    test = mi.chi2.ChiSquareTest(
        domain=domain,
        sample_func=sample,
        pdf_func=lambda wo: density(wo) * area(wo),
        sample_dim=3,
        sample_count=SAMPLES,
        res=101,
        ires=16,
    )
    accepted: bool = test.run(significance_level=SIGNIFICANCE, test_count=CASES, quiet=True)
    return accepted


@pytest.mark.parametrize(("roughness", "cosine"), MIRRORS)
def test_visible_normals_follow_their_density(roughness: float, cosine: float) -> None:
    lobes = kernel_lobes(specular=[0.9, 0.5, 0.2], roughness=roughness)
    wi = direction(cosine)
    domain = FacetDomain(wi, max(roughness**2, 1e-4))
    assert _chi_square(lobes, wi, domain, domain.area)


@pytest.mark.parametrize(("roughness", "cosine"), MIXTURES)
def test_the_mixture_follows_its_density(roughness: float, cosine: float) -> None:
    """With a shading normal that leans away from the triangle's, too."""
    import mitsuba as mi

    lobes = kernel_lobes(diffuse=[0.1, 0.4, 0.2], specular=0.5, roughness=roughness)
    domain = mi.chi2.SphericalDomain()
    leaning = (-0.6, 0.0, 0.8)
    assert _chi_square(lobes, direction(cosine), domain, lambda _: 1.0, leaning)


def test_the_test_notices_a_density_of_five_percent_more_roughness() -> None:
    wi = direction(0.5)
    domain = FacetDomain(wi, 0.09)
    claimed = kernel_lobes(specular=0.5, roughness=0.3 * 1.05)
    assert not _chi_square(
        kernel_lobes(specular=0.5, roughness=0.3), wi, domain, domain.area, claimed=claimed
    )
