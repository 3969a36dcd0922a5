"""The kernel's BRDF by itself: energy, sign, and how far it is reciprocal."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import ggx
from storage.records.multiscatter import directional_albedo
from tests.pipeline.renders.kernel_lobes import UP, direction, kernel_lobes, seen_at
from tests.storage.records.test_multiscatter import stretched

pytestmark = pytest.mark.usefixtures("llvm")


def test_the_lobe_returns_all_light_from_a_hundred_directions() -> None:
    """By its own samples: the mean of f cos / density, from the normal to a cosine of 1e-3."""
    for roughness in (0.01, 0.03, 0.1, 0.3, 0.5, 0.7, 0.85, 1.0):
        off = _returned(roughness) - 1
        # Measured: up to 0.37 %, of which the table has 0.25.
        assert abs(off).max() < 0.005, roughness


def _returned(roughness: float) -> NDArray:
    """Return the share of light that comes back from each of a hundred directions."""
    import drjit as dr
    import mitsuba as mi

    side, cosines = 96, np.geomspace(1e-3, 1, 100)
    count = side * side
    lanes = np.repeat(cosines, count)
    wi = mi.Vector3f(mi.Float(np.sqrt(1 - lanes**2)), 0, mi.Float(lanes))
    lobes = seen_at(kernel_lobes(specular=1.0, roughness=roughness), wi)
    middles = (np.arange(side) + 0.5) / side
    grid = [np.repeat(middles, side), np.tile(middles, side)]
    u = mi.Point2f(*(mi.Float(np.tile(axis, len(cosines))) for axis in grid))
    wo = ggx.sample(lobes, wi, mi.Float(0), u)
    reflected, density = ggx.evaluate(lobes, wi, wo, mi.Vector3f(*UP))
    returned = dr.block_sum(dr.select(density > 0, reflected.x / density, 0), count) / count
    return np.array(returned)


def test_no_mirror_reflects_to_below_the_triangle() -> None:
    """Where the shading normal would let it: the diffuse lobe alone is left, exactly."""
    import mitsuba as mi

    lobes = kernel_lobes(diffuse=0.3, specular=0.6, roughness=0.8)
    wi, wo = direction(0.5), mi.Vector3f(-0.8, 0.0, 0.6)
    leaning = mi.Vector3f(0.8, 0.0, 0.6)
    reflected, density = ggx.evaluate(seen_at(lobes, wi), wi, wo, leaning)
    assert float(reflected.x[0]) == pytest.approx(0.3 * 0.6 / np.pi, rel=1e-6)
    free, same_density = ggx.evaluate(seen_at(lobes, wi), wi, wo, mi.Vector3f(*UP))
    assert float(free.x[0]) > 1.5 * float(reflected.x[0])
    # It is still sampled, and what is sampled must be counted.
    assert float(density[0]) == float(same_density[0])


def test_nothing_is_negative_and_nothing_is_nan() -> None:
    import drjit as dr
    import mitsuba as mi

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
            result = ggx.evaluate(seen_at(lobes, directions[0]), *directions)
            for values in result:
                dr.eval(values)
                assert np.isfinite(np.array(values)).all()
                assert (np.array(values) >= 0).all()


def test_what_is_reciprocal_and_what_is_not() -> None:
    """Both lobes are before the scale; it breaks the law, by the ratio of the two albedos."""
    import mitsuba as mi

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
                there = ggx.evaluate(single, wi, wo, up)[0].x / wo.z
                back = ggx.evaluate(single, wo, wi, up)[0].x / wi.z
                # float32
                assert float(there[0]) == pytest.approx(float(back[0]), rel=1e-4)
                white = kernel_lobes(specular=1.0, roughness=roughness)
                there = ggx.evaluate(seen_at(white, wi), wi, wo, up)[0].x / wo.z
                back = ggx.evaluate(seen_at(white, wo), wo, wi, up)[0].x / wi.z
                # The table is exact to 0.25 % for each of the two.
                assert float(there[0] / back[0]) == pytest.approx(albedo[b] / albedo[a], rel=6e-3)


def _unit(vectors: NDArray) -> NDArray:
    unit: NDArray = vectors / np.linalg.norm(vectors, axis=0)
    return unit
