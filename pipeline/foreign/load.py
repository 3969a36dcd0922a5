"""From a file to triangles: by its format's own reader, a glTF by trimesh."""

import io

import numpy as np
import trimesh

from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import SourceFile
from storage.errors import Rejected


def load_mesh(source: SourceFile) -> TriangleMesh:
    """Return all triangles of a source in its own units, node transforms applied, +Z up.

    glTF defines +Y as up and is turned; USD says which axis is up, and its units, and comes in
    metres; the other formats define nothing and stay as they are. The
    vertices are as the file has them: unwelded, some unused, possibly not finite.

    Raises:
        Rejected: load_error, index_range, point_cloud, no_faces, header_size_mismatch, cut_off; of
            USD also too_many_faces and offset_precision.
    """
    if source.usd is not None:
        return source.usd.mesh
    if source.kind in ("glb", "gltf"):
        return _load_gltf(source)
    mesh, unread = source.contents.mesh, "; ".join(source.contents.unread)
    if len(mesh.faces) == 0:
        reason = "point_cloud" if len(mesh.positions) and not unread else "no_faces"
        raise Rejected(
            reason, "the file holds no triangles" + (f"; not read: {unread}" if unread else "")
        )
    return mesh


def _load_gltf(source: SourceFile) -> TriangleMesh:
    try:
        scene = trimesh.load_scene(
            io.BytesIO(source.data),
            file_type=source.kind,
            resolver=dict(source.buffers),
            process=False,
            skip_materials=True,
        )
        _check_geometries(scene)
        mesh = scene.to_mesh()
    except (MemoryError, Rejected):
        raise
    except Exception as error:
        # Readers of other people's files fail in every way that Python knows.
        reason = "index_range" if isinstance(error, IndexError) else "load_error"
        raise Rejected(reason, f"trimesh: {type(error).__name__}: {error!s:.200}") from error
    if len(mesh.faces) == 0:
        raise Rejected("no_faces", "the file holds no triangles, or no node places them")
    x, y, z = np.asarray(mesh.vertices, np.float64).T
    return TriangleMesh(
        positions=np.stack([x, -z, y], axis=1), faces=np.asarray(mesh.faces, np.int64)
    )


def _check_geometries(scene: trimesh.Scene) -> None:
    """Raise Rejected for what joining the geometries would hide."""
    meshes = [part for part in scene.geometry.values() if isinstance(part, trimesh.Trimesh)]
    if not any(len(part.faces) for part in meshes):
        if any(isinstance(part, trimesh.PointCloud) for part in scene.geometry.values()):
            raise Rejected("point_cloud", "the file holds points without triangles")
        raise Rejected("no_faces", "the file holds no triangles")
    for part in meshes:
        faces = np.asarray(part.faces)
        if len(faces) and not (0 <= faces.min() and faces.max() < len(part.vertices)):
            raise Rejected(
                "index_range",
                f"a face names vertex {faces.min() if faces.min() < 0 else faces.max()} "
                f"of {len(part.vertices)}",
            )
