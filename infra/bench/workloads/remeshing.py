"""Measures the decimation of one object; runs in the children of `trilight bench meshes`."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.foreign.mesh import TriangleMesh

REFERENCE = "reference recipe"
"""Method: isotropic remeshing at 0.5 % of the diagonal, then quadric collapse, without cleaning;
the public tool of RenderFormer's first version."""

METHODS: Mapping[str, str] = {
    "faithful": "pymeshlab_collapse",
    "faithful, GPL-free": "meshoptimizer",
    "uniform": "pymeshlab_uniform",
}
"""Trilight's methods by the name of their decimation; cleaning and orientation are included."""


def raw_mesh(path: Path) -> "TriangleMesh":
    """Return the mesh of a file in nominal size, neither cleaned nor oriented; raises Rejected."""
    from pipeline.assets.cleaning.clean import normalize
    from pipeline.foreign.limits import ReadLimits
    from pipeline.foreign.load import load_mesh
    from pipeline.foreign.source_file import read_source

    return normalize(load_mesh(read_source(path, ReadLimits())))


def clean_mesh(raw: "TriangleMesh") -> "TriangleMesh":
    """Return a raw mesh as the mesh stage decimates it; raises Rejected."""
    from pipeline.assets.cleaning.clean import clean
    from pipeline.assets.cleaning.orient import orient_outward

    return orient_outward(clean(raw))[0]


def count_faces(path: Path) -> int:
    """Return the number of triangles of a source after cleaning; raises Rejected."""
    from pipeline.assets.cleaning.clean import clean

    return len(clean(raw_mesh(path)).faces)


def remesh(path: Path, side: str, budget: int) -> dict[str, float]:
    """Return CPU seconds and quality of one object at one budget; raises Rejected.

    Loading the file and measuring the result are not counted, since every method needs them.
    """
    from pipeline.assets.cleaning.clean import clean
    from pipeline.assets.decimation.by_name import decimate
    from pipeline.assets.quality.measure import MeasuredSource

    raw = raw_mesh(path)
    source = clean_mesh(raw)
    started = time.process_time()
    if side == REFERENCE:
        result = _reference(raw.positions, raw.faces, budget)
    else:
        result = decimate(clean_mesh(raw), budget, METHODS[side])
    cpu_s = time.process_time() - started
    mesh = clean(result)
    quality = MeasuredSource(source).quality(mesh)
    return {
        "cpu_s": cpu_s,
        "faces": len(mesh.faces),
        "error_mean": quality.error_mean,
        "error_p99": quality.error_p99,
        "area_variation": quality.area_variation,
        "min_angle_p5_deg": quality.min_angle_p5_deg,
    }


def _reference(positions, faces, budget: int):  # type: ignore[no-untyped-def]
    import numpy as np
    import pymeshlab

    from pipeline.foreign.mesh import TriangleMesh

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(positions, faces.astype(np.int32)))
    meshes.meshing_isotropic_explicit_remeshing(
        targetlen=pymeshlab.PercentageValue(0.5), featuredeg=30.0
    )
    meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=budget, qualitythr=1.0)
    result = meshes.current_mesh()
    return TriangleMesh(
        positions=result.vertex_matrix(), faces=result.face_matrix().astype(np.int64)
    )
