"""Effect of decimation on pictures: path traced meshes compared with their cleaned source.

One object is on a floor under one lamp; camera, material and random numbers are equal for all of
its meshes. Meshes are made in a mesh child, and rendered in a render child.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from infra.bench.workloads.remeshing import clean_mesh, raw_mesh
from pipeline.foreign.mesh import TriangleMesh
from pipeline.renders.settings import RenderSettings
from storage.conventions import look_at_c2w
from storage.metrics import psnr_log_db
from storage.records.scene import Scene, SceneObject

_SMOOTH_ANGLE_DEG = 30.0
_EYE = (1.6, -1.6, 1.0)
_FOV_DEG = 35.0
_LAMP = ((0.8, -1.2, 2.0), (1.3, -0.9, 2.0), (0.9, -0.7, 2.2))
_RADIANCE = 200.0
"""Radiance that gives pictures the median brightness of `smoke`, 0.23, on which dB depend."""


def coarser(path: Path, budgets: Sequence[int], method: str) -> list[TriangleMesh]:
    """Return the cleaned source of a file, and one mesh for each budget; raises Rejected."""
    from pipeline.assets.cleaning.clean import clean
    from pipeline.assets.decimation.by_name import decimate

    source = clean_mesh(raw_mesh(path))
    meshes = [source, *(clean(decimate(source, budget, method)) for budget in budgets)]
    return [
        TriangleMesh(  # of the declared types: a mesh leaves its child with no other
            positions=np.ascontiguousarray(mesh.positions, np.float64),
            faces=np.ascontiguousarray(mesh.faces, np.int64),
        )
        for mesh in meshes
    ]


def picture_db(meshes: Sequence[TriangleMesh], renders: RenderSettings) -> list[float]:
    """Return psnr_log_db of each further mesh, and of the first again, to the first's picture.

    The last value is the first mesh with other random numbers, which bounds the others.
    """
    from pipeline.renders.renderer import SceneRenderer

    def picture(mesh: TriangleMesh, seed: int) -> NDArray[np.float32]:
        scene = _scene(mesh, floor_z=float(meshes[0].positions[:, 2].min()))
        return SceneRenderer(scene, renders).render_view(scene.c2w[0], _FOV_DEG, seed).radiance_rgb

    source = picture(meshes[0], 0)
    pictures = [*(picture(mesh, 0) for mesh in meshes[1:]), picture(meshes[0], 1)]
    return [psnr_log_db(source, other) for other in pictures]


def _scene(mesh: TriangleMesh, *, floor_z: float) -> Scene:
    from pipeline.scenes.pieces import concatenate_pieces, emitter_piece, object_piece, shell_piece
    from scene_templates.layout import Emitter, ShellPart, SurfaceLook

    rng = np.random.default_rng(0)  # for materials of many colours, which these are not
    matt = SurfaceLook(
        diffuse_scale=0.5, diffuse_rgb=(0.5, 0.5, 0.5), specular_rgb=(0.0, 0.0, 0.0),
        roughness=1.0, smooth=False, colours="one",
    )  # fmt: skip
    glossy = dataclasses.replace(
        matt, diffuse_rgb=(0.5, 0.3, 0.2), specular_rgb=(0.3, 0.3, 0.3), roughness=0.4, smooth=True
    )
    corners = np.array([[-2.0, -2, floor_z], [2, -2, floor_z], [2, 2, floor_z], [-2, 2, floor_z]])
    floor = ShellPart(
        name="floor", positions=corners, faces=np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        surface=matt,
    )  # fmt: skip
    lamp = Emitter(triangle=np.array(_LAMP), radiance_rgb=(_RADIANCE,) * 3, reflectance=0.0)
    entry = SceneObject(name="object", kind="object")
    positions = mesh.positions.astype(np.float32)
    faces = mesh.faces.astype(np.uint32)
    pieces = [
        shell_piece(floor, rng, _SMOOTH_ANGLE_DEG),
        object_piece(entry, positions, faces, glossy, rng, _SMOOTH_ANGLE_DEG),
        emitter_piece(lamp, 0),
    ]
    c2w = look_at_c2w(eye=_EYE, target=(0, 0, 0), up=(0, 0, 1))
    return Scene(
        **concatenate_pieces(pieces),
        c2w=c2w.astype(np.float32)[None],
        fov_deg=np.array([_FOV_DEG], np.float32),
        objects=tuple(piece.entry for piece in pieces),
        provenance={},
    )
