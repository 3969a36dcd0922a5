"""Normal maps in the kernel: frames, energy, and Mitsuba's own `normalmap` beside them."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.load_tracer import load_tracer
from storage.optics.normal_map import FLAT
from storage.raycast.first_hits import first_hits
from storage.records.environment import Environment
from storage.records.material import DIFFUSE
from storage.records.retextured import with_textures
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.oracle.kernel_bsdf import exact_twin
from tests.pipeline.renders.sampling import assert_agree, assert_honest, camera_of, render_blocks
from tests.pipeline.renders.scene_kit import (
    SKY_LAMP,
    Part,
    furnace,
    join,
    light,
    material,
    sphere,
    textured_floor,
)

pytestmark = pytest.mark.usefixtures("llvm")


def bumps(seed: int, tilt: float, size: tuple[int, int] = (5, 7)) -> Texture:
    """Return a map of independent normals up to `tilt` (its tangent) off."""
    slope = np.random.default_rng(seed).uniform(-tilt, tilt, (*size, 2))
    normal = np.concatenate([slope, np.ones((*size, 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Texture(texels=((normal + 1) / 2).astype(np.float32))


def one_normal(x: float, y: float, z: float) -> Texture:
    normal = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    return Texture(texels=((normal + 1) / 2).astype(np.float32)[None, None])


def mapped(
    parts: list[Part], normals: Texture, uv: NDArray | None = None, sky: Environment | None = None
) -> Scene:
    """Return parts, of which the first has a normal map; u and v go with x and y by default."""
    scene = join(parts, eye=(0, -0.02, 4), fov_deg=30, sky=sky)
    place = scene.vertex_positions[scene.faces.ravel(), :2] if uv is None else uv
    index = np.full((len(parts), 3), -1, np.int32)
    rows = np.array([0] + [-1] * (len(parts) - 1), np.int32)
    found = with_textures(scene, (1.5 * place).astype(np.float32), (normals,), index, rows)
    found.check()
    return found


def _room(normals: Texture) -> Scene:
    ball = sphere([0.2, 0.1, 0.4], 0.4, material(diffuse=0.2, specular=0.7, roughness=0.3), 8)
    floor = textured_floor(material(diffuse=0.3, specular=0.6, roughness=0.4))
    return mapped([floor, ball, SKY_LAMP], normals)


def test_the_kernel_agrees_with_mitsubas_normalmap(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = _room(bumps(1, 1.5))
    ours = render_blocks(scene)
    twin = exact_twin(scene, monkeypatch, max_depth=10, rr_depth=5)
    theirs = render_blocks(scene, first_seed=500, tracer=twin)
    assert_agree(ours, theirs, slack=1e-3)
    assert_honest(ours, theirs)
