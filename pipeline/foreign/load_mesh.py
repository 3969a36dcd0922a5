"""`load_mesh`: the triangles of a file, by the reader of its format."""

from pipeline.foreign.gltf.primitives import gltf_mesh
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.source_file import SourceFile
from storage.errors import Rejected


def load_mesh(source: SourceFile) -> TriangleMesh:
    """Return all triangles of a source in its own units, node transforms applied, +Z up.

    glTF defines +Y as up and is rotated. USD states its up axis and its units, and is converted to
    meters. The other formats define neither and stay as they are. The vertices are as the file has
    them: unwelded, some unused, possibly not finite.

    Raises:
        Rejected: load_error, index_range, point_cloud, no_faces, header_size_mismatch, cut_off; of
            glTF also unsupported_accessor; of USD also too_many_faces and offset_precision.
    """
    if source.usd is not None:
        return source.usd.mesh
    if source.gltf is not None:
        return gltf_mesh(source.gltf)
    mesh = source.contents.mesh
    unread = "; ".join(source.contents.unread)
    if len(mesh.faces) == 0:
        reason = "point_cloud" if len(mesh.positions) and not unread else "no_faces"
        raise Rejected(
            reason, "the file holds no triangles" + (f"; not read: {unread}" if unread else "")
        )
    return mesh
