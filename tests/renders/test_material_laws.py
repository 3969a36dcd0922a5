"""Surfaces reflect what their ten numbers say: energy, two sides, the mixture of lobes."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.blend import MIN_ALPHA, lobes_of, scaled_albedos
from storage.conventions import alpha_ggx
from storage.scene import Scene
from tests.renders.sampling import assert_agree, exact, render_blocks
from tests.renders.scene_kit import Part, flat, furnace, join, light, material, quad, sphere

PLATE = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]


def _albedo_of_ggx(cos_in: float, roughness: float) -> float:
    """Directional albedo at specular 1 by brute force: the slow twin of the kernel's lobe.

    Integrates over the half vector, in the angle where the peak is wide.
    """
    alpha = float(alpha_ggx(roughness))
    incoming = np.array([np.sqrt(1 - cos_in**2), 0.0, cos_in])
    cosine, sine = _half_angles(alpha)
    phi = (np.arange(720) + 0.5) * 2 * np.pi / 720
    half = np.stack(
        [sine[:, None] * np.cos(phi), sine[:, None] * np.sin(phi), cosine[:, None] + 0 * phi], -1
    )
    projected = half @ incoming
    outgoing_z = 2 * projected * half[..., 2] - incoming[2]
    useful = (projected > 0) & (outgoing_z > 0)
    cos_out = np.where(useful, outgoing_z, 1.0)
    # Half vectors are drawn by D cos, so D and the solid angle cancel:
    # f cos_o dwo = D G / (4 ci co) * co * 4 (i.h) dwh = D G (i.h) / ci dwh.
    weight = _g1(cos_in, alpha) * _g1(cos_out, alpha) * projected / (cos_in * half[..., 2])
    return float(np.where(useful, weight, 0.0).mean())


def _half_angles(alpha: float, count: int = 4000) -> tuple[NDArray, NDArray]:
    """Return cosine and sine of half vectors at the midpoints of equal shares of D cos."""
    share = (np.arange(count) + 0.5) / count
    tangent_sq = alpha**2 * share / (1 - share)
    cosine = 1 / np.sqrt(1 + tangent_sq)
    return cosine, cosine * np.sqrt(tangent_sq)


def _g1(cosine: float | NDArray, alpha: float) -> NDArray:
    tangent_sq = 1 / np.square(cosine) - 1
    return 2 / (1 + np.sqrt(1 + alpha**2 * tangent_sq))


def _furnace_plate(row: NDArray, cos_view: float) -> Scene:
    eye = 3 * np.array([0.0, -np.sqrt(1 - cos_view**2), cos_view])
    return join([quad(PLATE, row), furnace()], eye=eye, fov_deg=0.5)


@pytest.mark.parametrize("roughness", [0.01, 0.1, 0.4, 0.7, 1.0])
@pytest.mark.parametrize("cos_view", [0.95, 0.3])
def test_a_plate_in_a_furnace_returns_the_directional_albedo(
    roughness: float, cos_view: float
) -> None:
    """Nearly 1 where smooth; at roughness 1 only what single scattering leaves (0.3 to 0.6)."""
    specular, diffuse = 0.75, 0.2
    row = material(diffuse=diffuse, specular=specular, roughness=roughness)
    expected = diffuse + specular * _albedo_of_ggx(cos_view, roughness)
    estimate = render_blocks(_furnace_plate(row, cos_view), resolution=8, block=8, max_depth=2)
    # The quadrature is good to 1e-4; float32 half vectors cost some 1e-4 at roughness 0.01.
    assert_agree(estimate, exact(np.full((1, 1, 3), expected)), slack=1e-3)


@pytest.mark.parametrize(
    "row",
    [
        material(diffuse=[0.9, 0.5, 0.0]),
        material(specular=[1.0, 0.6, 0.2], roughness=0.05),
        material(),
        material(diffuse=1e-4, specular=0.9, roughness=0.05),
        material(diffuse=0.9, specular=1e-4, roughness=0.05),
    ],
    ids=["diffuse only", "mirror only", "black", "nearly mirror", "nearly diffuse"],
)
def test_the_ends_of_the_mixture_are_exact(row: NDArray) -> None:
    estimate = render_blocks(_furnace_plate(row, 0.8), resolution=8, block=8, max_depth=2)
    expected = row[0:3] + row[3:6] * _albedo_of_ggx(0.8, row[6])
    assert_agree(estimate, exact(expected[None, None]), slack=1e-3)


def test_a_surface_shades_the_same_from_behind() -> None:
    """Turning all triangles and normals around changes no picture: nothing has a back."""
    row = material(diffuse=[0.3, 0.2, 0.5], specular=0.4, roughness=0.3)
    floor = quad([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], material(diffuse=0.5))
    lamp = light([[-0.5, 0, 2], [0.5, 0, 2], [0, 0.6, 1.8]], 6.0)
    ball = sphere([0, 0, 0.5], 0.5, row, rings=8)
    turned = Part(
        triangles=ball.triangles[:, ::-1],
        normals=-ball.normals[:, ::-1],
        material=row,
        kind="object",
    )
    front, back = (
        render_blocks(join([floor, part, lamp], eye=(0, -2, 1)), first_seed=seed)
        for seed, part in enumerate([ball, turned])
    )
    assert_agree(front, back)


def test_shading_normals_are_those_of_the_scene() -> None:
    """A flat plate with tilted normals is as bright as a plate that is really tilted so."""
    row = material(diffuse=0.8)
    normal = np.array([0.0, np.sin(0.3), np.cos(0.3)])
    plate = flat([[[-0.2, -0.2, 0], [0.2, -0.2, 0], [0, 0.3, 0]]], row)
    tilted = dataclasses.replace(plate, normals=np.broadcast_to(normal, (1, 3, 3)))
    far = np.array([[-20, 30, 40], [20, 30, 40], [0, 50, 60]])
    picture = render_blocks(
        join([tilted, light(far, 1.0)], eye=(0, 0, 2), target=(0, 0.001, 0), fov_deg=2),
        resolution=8,
        block=8,
        max_depth=2,
    )
    spokes = far / np.linalg.norm(far, axis=1, keepdims=True)
    edges = np.cross(spokes, np.roll(spokes, -1, axis=0))
    angles = np.arcsin(np.linalg.norm(edges, axis=1))
    directions = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    irradiance = abs((angles[:, None] * directions @ normal[:, None]).sum()) / 2
    # The view is 0.07 wide and the light 60 away: moving there changes the form factor by 0.2 %.
    assert_agree(picture, exact(np.full((1, 1, 3), 0.8 / np.pi * irradiance)), slack=2e-3)


def test_lobes_add_up_to_the_material_and_never_exceed_one() -> None:
    rng = np.random.default_rng(0)
    rows = np.zeros((500, 10), np.float32)
    split = rng.uniform(size=(500, 3))
    rows[:, 0:3], rows[:, 3:6] = split * 0.97, (1 - split) * 0.97
    rows[:, 6] = rng.uniform(size=500)
    rows[0, 0:6], rows[1, 0:3], rows[2, 3:6] = 0, 0, 0
    lobes = lobes_of(rows)
    diffuse, specular = scaled_albedos(lobes)
    weight = lobes.weight[:, None]
    # float64 arithmetic on float32 rows: exact to 1e-12.
    np.testing.assert_allclose((1 - weight) * diffuse, rows[:, 0:3], atol=1e-12)
    np.testing.assert_allclose(weight * specular, rows[:, 3:6], atol=1e-12)
    bound = lobes.diffuse.max(1) + lobes.specular.max(1) + 1e-12
    assert (diffuse.max(1) <= bound).all() and (specular.max(1) <= bound).all()
    assert lobes.weight[0] == 0 and lobes.weight[1] == 1 and lobes.weight[2] == 0
    np.testing.assert_allclose(
        lobes.alpha, np.maximum(rows[:, 6].astype(np.float64) ** 2, MIN_ALPHA)
    )
