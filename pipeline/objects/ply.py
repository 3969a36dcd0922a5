"""Binary PLY: a plain mesh format that every modeling program opens."""

import numpy as np
from numpy.typing import NDArray


def encode_ply(positions: NDArray[np.floating], faces: NDArray[np.integer]) -> bytes:
    """Return a mesh as binary PLY: float32 positions [V, 3], triangles [F, 3]."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(positions)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"] = 3
    rows["corners"] = faces
    return header.encode() + positions.astype("<f4").tobytes() + rows.tobytes()
