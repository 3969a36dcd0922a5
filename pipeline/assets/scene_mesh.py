"""Remeshes the surface of a scene's mesh; it runs in a child process."""

import numpy as np

from pipeline.assets.cleaning.clean import clean, normalize
from pipeline.assets.decimation.decimate import decimate, safe_method
from pipeline.assets.recipe import methods_of
from pipeline.assets.settings import Profile
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected


def remesh(raw: TriangleMesh, num_faces: int, profile: Profile = "uniform") -> TriangleMesh:
    """Return the surface with at most `num_faces` triangles, in the units of the file.

    This is the mesh stage without its quality checks; RenderFormer's own remeshing gives other
    triangles.

    Raises:
        Rejected: "remesh_failed" where no method gives that many.
        TrilightError: `uniform` without pymeshlab.
    """
    used = raw.positions[np.unique(raw.faces)]
    low = used.min(axis=0)
    high = used.max(axis=0)
    unit = clean(normalize(raw))
    if len(unit.faces):
        for method in methods_of(profile):
            try:
                result = decimate(unit, num_faces, safe_method(unit, method))
            except Rejected:
                continue
            if 0 < len(result.faces) <= num_faces:
                positions = result.positions * (high - low).max() + (low + high) / 2
                return TriangleMesh(positions=positions, faces=result.faces)
    raise Rejected("remesh_failed", f"no method gives at most {num_faces} triangles")
