"""Emitters are picked by power, whatever their number."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.renders.emitter_table import EmitterTable, alias_table
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import RenderSettings
from storage.errors import Rejected
from tests.pipeline.renders.scene_kit import join, light, material, quad


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=40).filter(lambda values: sum(values) > 0))
def test_the_alias_table_gives_each_row_its_share(power: list[float]) -> None:
    share = np.array(power) / sum(power)
    keep, alias = alias_table(share)
    assert ((keep >= 0) & (keep <= 1)).all()
    picked = keep / len(share)
    np.add.at(picked, alias, (1 - keep) / len(share))
    # Each of up to 40 subtractions rounds to 1e-16 of a value of at most 40.
    np.testing.assert_allclose(picked, share, atol=1e-13)


@pytest.mark.usefixtures("llvm")
def test_sampled_points_lie_on_their_triangle_and_come_by_power() -> None:
    import drjit as dr
    import mitsuba as mi

    triangles = np.random.default_rng(1).normal(size=(3, 3, 3))
    strengths = [1.0, 30.0, 5.0]
    floor = quad([[-1, -1, -9], [1, -1, -9], [1, 1, -9], [-1, 1, -9]], material(diffuse=0.5))
    scene = join([floor, *(light(t, s) for t, s in zip(triangles, strengths, strict=True))])
    rows = np.flatnonzero(scene.triangle_emits)
    table = EmitterTable(scene, rows)
    side = 800
    grid = (np.arange(side) + 0.5) / side
    u = mi.Point2f(mi.Float(np.repeat(grid, side)), mi.Float(np.tile(grid, side)))
    point = table.sample(u, mi.Bool(True))
    dr.eval(point.position, point.radiance, point.area_density)
    radiance = np.array(point.radiance)[0]
    position = np.array(point.position).T.astype(np.float64)
    edge1, edge2 = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = np.cross(edge1, edge2)
    area = np.linalg.norm(normal, axis=1) / 2
    share = area * strengths / (area * strengths).sum()
    for row, strength in enumerate(strengths):
        mine = radiance == np.float32(strength)
        # A row's part of the picking variable has at most four ends, each within a stratum.
        assert abs(mine.mean() - share[row]) < 4 / side
        edges = np.stack([edge1[row], edge2[row]])
        offset = position[mine] - triangles[row, 0]
        weights = np.linalg.lstsq(edges.T, offset.T, rcond=None)[0]
        back = triangles[row, 0] + weights.T @ edges
        # Float32 positions of size about 3.
        np.testing.assert_allclose(back, position[mine], atol=2e-6)
        assert (weights > -1e-5).all() and (weights.sum(0) < 1 + 1e-5).all()
        np.testing.assert_allclose(
            np.array(point.area_density)[mine], share[row] / area[row], rtol=1e-5
        )
        # Uniform on the triangle: the mean point is the centroid, as far as the row's strata tell.
        np.testing.assert_allclose(weights.mean(1), 1 / 3, atol=1 / (side * share[row]))


def test_emitters_without_area_are_rejected() -> None:
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    scene = join([floor, light([[0, 0, 1], [1, 0, 1], [0, 1, 1]], 1.0)])
    scene.vertex_positions[-3:] = [[0, 0, 1], [1, 0, 1], [2, 0, 1]]
    settings = RenderSettings(resolution=8, noise_floor_db=20, min_spp=8, max_spp=8)
    with pytest.raises(Rejected, match="unlit_scene"):
        SceneRenderer(scene, settings)
