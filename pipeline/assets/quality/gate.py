"""The gate at the end: what a level must fulfil whatever made it."""

import numpy as np

from pipeline.assets.clean import clean
from pipeline.assets.distance import Surface
from pipeline.assets.mesh import TriangleMesh
from storage.errors import Rejected

BOX_MARGIN = 0.01
"""How far a level may stick out of its source's bounding box, as a share of its diagonal."""


def check_level(
    result: TriangleMesh, source: Surface, budget: int, max_error_p99: float
) -> tuple[TriangleMesh, float]:
    """Return the cleaned result of a decimation, and its two-way p99 distance to the source.

    Raises:
        Rejected: nonfinite_result, bbox_escaped, budget_missed, error_over_bound.
    """
    used = result.positions[np.unique(result.faces)]
    if len(used) == 0:
        raise Rejected("budget_missed", f"no face is left; expected 1 to {budget}")
    if not np.isfinite(used).all():
        raise Rejected("nonfinite_result", "a vertex of the result is not finite")
    low, high = source.mesh.positions.min(axis=0), source.mesh.positions.max(axis=0)
    outside = float(np.maximum(low - used, used - high).max()) / source.mesh.diagonal
    if outside > BOX_MARGIN:
        raise Rejected("bbox_escaped", f"a vertex is {outside:.2%} of the diagonal outside the box")
    mesh = clean(result)
    if not 1 <= len(mesh.faces) <= budget:
        raise Rejected("budget_missed", f"{len(mesh.faces)} faces; expected 1 to {budget}")
    error = source.p99_to(mesh)
    if error > max_error_p99:
        raise Rejected(
            "error_over_bound",
            f"p99 distance {error:.2%} at {budget} faces; <= {max_error_p99:.2%}",
        )
    return mesh, error
