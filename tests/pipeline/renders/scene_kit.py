"""Small scenes for the render tests: parts in numpy, joined to a `Scene`, or what is composed."""

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import look_at_c2w
from storage.records.retextured import with_textures
from storage.records.scene import ObjectKind, Scene, SceneObject
from storage.records.texture import Environment, Texture
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.scene_templates.balls import DEFAULTS
from tests.textured_by_hand import bumps


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """One object of a test scene: triangles [T, 3, 3], normals [T, 3, 3], one material row [10]."""

    triangles: NDArray[np.float64]
    normals: NDArray[np.float64]
    material: NDArray[np.float64]
    kind: ObjectKind


def material(
    *,
    diffuse: ArrayLike = 0.0,
    specular: ArrayLike = 0.0,
    roughness: float = 1.0,
    emission: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Return one material row; scalars mean grey."""
    row = np.zeros(10)
    row[0:3], row[3:6], row[6], row[7:10] = diffuse, specular, roughness, emission
    return row


def flat(triangles: ArrayLike, material_row: NDArray, kind: ObjectKind = "object") -> Part:
    """Return a part whose shading normals are those of its faces."""
    corners = np.asarray(triangles, np.float64).reshape(-1, 3, 3)
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face_normals /= np.linalg.norm(face_normals, axis=1, keepdims=True)
    normals = np.repeat(face_normals[:, None], 3, axis=1)
    return Part(triangles=corners, normals=normals, material=material_row, kind=kind)


def quad(corners: ArrayLike, material_row: NDArray, kind: ObjectKind = "shell") -> Part:
    """Return a flat quadrilateral from its four corners [4, 3] in order."""
    ring: NDArray[np.float64] = np.asarray(corners, np.float64)
    return flat(ring[np.array([[0, 1, 2], [0, 2, 3]])], material_row, kind)


def light(triangle: ArrayLike, radiance: ArrayLike, diffuse: ArrayLike = 0.0) -> Part:
    """Return one emitting triangle [3, 3], black unless said otherwise."""
    return flat(np.asarray(triangle), material(diffuse=diffuse, emission=radiance), "emitter")


def sphere(centre: ArrayLike, radius: float, material_row: NDArray, rings: int = 12) -> Part:
    """Return a smooth sphere of 4 * rings * (rings - 1) triangles."""
    theta = np.linspace(0, np.pi, rings + 1)
    phi = np.linspace(0, 2 * np.pi, 2 * rings + 1)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    grid = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    # At the poles one of the two triangles of a cell has no area.
    lower = np.stack([a, b, c], axis=-2)[:-1].reshape(-1, 3, 3)
    upper = np.stack([a, c, d], axis=-2)[1:].reshape(-1, 3, 3)
    unit = np.concatenate([lower, upper])
    corners = unit * radius + np.asarray(centre, np.float64)
    return Part(triangles=corners, normals=unit, material=material_row, kind="object")


def box(
    centre: ArrayLike,
    size: float,
    material_row: NDArray,
    turn: float = 0.0,
    kind: ObjectKind = "object",
) -> Part:
    """Return a flat cube of 12 triangles, turned about z by `turn` radians."""
    corners = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal, u, v = (np.eye(3)[(axis + step) % 3] for step in range(3))
            normal, u = normal * sign, u * sign
            ring = np.array([normal - u - v, normal + u - v, normal + u + v, normal - u + v])
            corners.append(quad(ring * size / 2, material_row).triangles)
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    placed = np.concatenate(corners) @ rotation.T + np.asarray(centre, np.float64)
    return flat(placed, material_row, kind)


def furnace(radiance: float = 1.0) -> Part:
    """Return a box around everything that emits the same radiance from everywhere."""
    return box([0, 0, 0], 40.0, material(emission=radiance), kind="emitter")


def join(
    parts: Sequence[Part],
    *,
    eye: ArrayLike = (0.0, -2.0, 0.5),
    target: ArrayLike = (0.0, 0.0, 0.0),
    fov_deg: float = 40.0,
    sky: Environment | None = None,
) -> Scene:
    """Return the scene of `parts` with one camera; every part has its own material row."""
    counts = [len(part.triangles) for part in parts]
    rows = np.repeat(np.arange(len(parts)), counts).astype(np.uint16)
    positions = np.concatenate([part.triangles for part in parts]).reshape(-1, 3)
    scene = Scene(
        vertex_positions=positions.astype(np.float32),
        vertex_normals=np.concatenate([part.normals for part in parts])
        .reshape(-1, 3)
        .astype(np.float32),
        faces=np.arange(3 * sum(counts), dtype=np.uint32).reshape(-1, 3),
        material_index=rows,
        materials=np.array([part.material for part in parts], np.float32),
        object_index=rows,
        c2w=look_at_c2w(eye=eye, target=target, up=(0, 0, 1))[None].astype(np.float32),
        fov_deg=np.array([fov_deg], np.float32),
        objects=tuple(
            SceneObject(name=f"{part.kind}{row}", kind=part.kind) for row, part in enumerate(parts)
        ),
        provenance={},
        environment=sky,
    )
    scene.check()
    return scene


def furniture() -> list[Part]:
    """Return things on a floor, nothing smoother than roughness 0.3: the noise has no long tail."""
    s = 0.5
    return [
        quad(
            [[-s, -s, -s], [s, -s, -s], [s, s, -s], [-s, s, -s]],
            material(diffuse=[0.2, 0.5, 0.4], specular=0.4, roughness=0.4),
        ),
        quad(
            [[-s, s, -s], [s, s, -s], [s, s, s], [-s, s, s]],
            material(diffuse=[0.7, 0.3, 0.3], specular=0.2, roughness=0.9),
        ),
        sphere([-0.15, 0.1, -0.2], 0.25, material(diffuse=0.1, specular=0.8, roughness=0.3), 8),
        box([0.25, -0.1, -0.3], 0.3, material(diffuse=[0.1, 0.2, 0.8], roughness=1.0), turn=0.4),
    ]


def open_scene(sky: Environment | None, num_lights: int = 2) -> Scene:
    """Return the furniture below a sky and so many lamps."""
    parts = furniture()
    lamps = [[[0.2, -0.9, 0.9], [0.4, -0.9, 1.0], [0.2, -0.7, 0.8]],
             [[-0.9, -0.5, 0.6], [-0.9, -0.3, 0.6], [-0.8, -0.4, 0.8]]]  # fmt: skip
    parts += [light(lamp, [6.0, 8.0, 7.0], diffuse=1.0) for lamp in lamps[:num_lights]]
    return join(parts, eye=(0.5, -1.7, 0.6), fov_deg=45, sky=sky)


SKY_LAMP = light(np.array([[-1, -1, 3], [2, -1, 3], [0, 1, 2.5]]), 5.0)


def textured_floor(row: NDArray[np.float64]) -> Part:
    """Return a floor of 2 m, the part that `textured` puts its textures on."""
    return quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], row)


def lamp_over_floor(radiance: float = 5.0) -> Scene:
    """Return the smallest scene: three triangles."""
    lamp = light([[-0.1, -0.1, 3], [0, 0.1, 3], [0.1, -0.1, 3]], radiance)
    return join([textured_floor(material(diffuse=0.5)), lamp], eye=(0, -2, 1))


def textured(
    parts: list[Part],
    textures: tuple[Texture, ...],
    of_floor: list[int],
    scale: float = 1.0,
    fov: float = 30,
) -> Scene:
    """Return parts, of which the first is textured; u and v go with x and y: 0 to 1 over it."""
    scene = join(parts, eye=(0, -0.02, 4), fov_deg=fov)
    index = np.full((len(parts), 3), -1, np.int32)
    index[0] = of_floor
    xy = scene.vertex_positions[scene.faces.ravel(), :2]
    uv = (scale * (xy + 1) / 2).astype(np.float32)
    found = with_textures(scene, uv, textures, index)
    found.check()
    return found


def mapped(parts: list[Part], normals: Texture, turn_uv: NDArray | None = None) -> Scene:
    """Return parts, of which the first has a normal map; u and v go with x and y."""
    scene = join(parts, eye=(0, -0.02, 4), fov_deg=30)
    place = scene.vertex_positions[scene.faces.ravel(), :2]
    uv = (1.5 * (place if turn_uv is None else place @ turn_uv.T)).astype(np.float32)
    index = np.full((len(parts), 3), -1, np.int32)
    rows = np.array([0] + [-1] * (len(parts) - 1), np.int32)
    found = with_textures(scene, uv, (normals,), index, rows)
    found.check()
    return found


def bumpy_room() -> Scene:
    """Return a ball on a floor whose normals are up to 65 degrees off."""
    ball = sphere([0.2, 0.1, 0.4], 0.4, material(diffuse=0.2, specular=0.7, roughness=0.3), 8)
    floor = textured_floor(material(diffuse=0.3, specular=0.6, roughness=0.4))
    return mapped([floor, ball, SKY_LAMP], bumps(1, 1.5))


def noise_map(seed: int, channels: int, low: float, high: float) -> Texture:
    """Return a texture of 7 x 5 independent texels."""
    drawn = np.random.default_rng(seed).uniform(low, high, (5, 7, channels))
    return Texture(texels=drawn.astype(np.float32))


def sampled_like_scene(rng: np.random.Generator, *, num_views: int = 4) -> Scene:
    """Return a scene as the templates draw it: shell, objects, lights and cameras.

    With generators of the seeds 0 to 5 the third one of each fills two thirds of its picture and
    more, in three layouts, with 1 to 8 lights.
    """
    settings = dataclasses.replace(DEFAULTS, num_views=num_views)
    return first_scene(settings, small_pool(), seed=int(rng.integers(1 << 30)), scene_index=3)


GUIDED_FLOOR = [[-1.5, -1.5, 0], [1.5, -1.5, 0], [1.5, 1.5, 0], [-1.5, 1.5, 0]]
GUIDED_WALL = [[-1.5, 1.5, 0], [1.5, 1.5, 0], [1.5, 1.5, 2], [-1.5, 1.5, 2]]
GUIDED_LAMP = [[0.8, 0.3, 1.3], [1.2, 0.3, 1.3], [0.9, 0.7, 1.4]]


def mirrors(roughness: float = 0.3) -> Scene:
    """A mirror shows a matt floor on which metal throws light."""
    metal = material(specular=[0.9, 0.8, 0.7], roughness=roughness)
    parts = [
        quad(GUIDED_FLOOR, material(diffuse=0.6, specular=0.2, roughness=0.5)),
        quad(np.subtract(GUIDED_WALL, [0, 0.3, 0]), material(specular=0.9, roughness=0.2)),
        box([0.4, -0.2, 0.4], 0.5, metal, 0.4),
        sphere([-0.4, 0.2, 0.3], 0.25, metal, 6),
        light(GUIDED_LAMP, 30.0, 0.5),
    ]
    return join(parts, eye=(0.3, -2.4, 1.0), target=(0, 0.6, 0.4), fov_deg=50)


@functools.cache
def lit_by_a_mirror(size: float, roughness: float = 0.3) -> Scene:
    """A lamp of so many metres in a black box, which is open towards a mirror.

    Floor and walls are matt, and all light on them came from the mirror. So both hits of camera
    paths and light paths have a large part of it: what one of them takes for the density of the
    other shows in the mean.
    """
    centre, matt = np.array([-0.9, 0, 0.8]), material(diffuse=0.8)
    shade = box([0, 0, 0], 1.0, material()).triangles
    open_shade = shade[shade.mean(axis=1)[:, 0] < 0.49] * [0.21, 1.2 * size, 1.2 * size]
    mirror = [[1.2, -0.6, 0.2], [1.2, 0.6, 0.2], [1.2, 0.6, 1.4], [1.2, -0.6, 1.4]]
    lamp = np.array([[0.0, -0.5, -0.5], [0, 0.5, -0.5], [0, 0, 0.5]]) * size
    parts = [
        quad(GUIDED_FLOOR, matt),
        quad(GUIDED_WALL, matt),
        quad([[-1.5, -1.5, 0], [-1.5, 1.5, 0], [-1.5, 1.5, 2], [-1.5, -1.5, 2]], matt),
        quad(mirror, material(specular=0.95, roughness=roughness)),
        flat(open_shade + centre + [0.095, 0, 0], material(), "shell"),
        light(lamp + centre, 200.0),
    ]
    return join(parts, eye=(-0.2, -3.2, 1.2), target=(0, 0.6, 0.6), fov_deg=45)
