"""What a picture must show, where mathematics knows."""

import numpy as np
from numpy.typing import NDArray


def lambert_irradiance(
    points: NDArray, normal: NDArray, polygon: NDArray, radiance: float
) -> NDArray:
    """Lambert's formula for a polygon that is wholly above the horizon of every point."""
    spokes = polygon[None] - points[:, None]
    spokes /= np.linalg.norm(spokes, axis=-1, keepdims=True)
    total = np.zeros(len(points))
    for corner in range(len(polygon)):
        a, b = spokes[:, corner], spokes[:, (corner + 1) % len(polygon)]
        edge = np.cross(a, b)
        edge /= np.linalg.norm(edge, axis=-1, keepdims=True)
        angle = np.arccos(np.clip((a * b).sum(-1), -1, 1))
        total += angle * (edge @ normal)
    return np.abs(total) * radiance / 2
