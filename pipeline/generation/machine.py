"""The number of render children that share a GPU."""

_MOST_CHILDREN = 4
"""Children of a GPU. One that only renders fills an H200 (60,700 views an hour, four 58,500), but a
child also composes, checks and encodes on the CPU meanwhile."""

_CHILD_BYTES = 1 << 30
"""GPU memory of a render child; four used 4.6 GB in all on an H200."""

_PIXEL_BYTES = 2400
"""More of it for each pixel: a pass of 64 samples, which Dr.Jit rounds up to powers of two."""

_USED = 0.9
"""Fraction of a GPU's memory that render children may fill."""


def children_of_gpu(resolution: int, memory_bytes: int) -> int:
    """Return how many render children keep a GPU busy and fit into its memory.

    Args:
        resolution: of their pictures, in pixels.
        memory_bytes: of the GPU.
    """
    child_bytes = _CHILD_BYTES + _PIXEL_BYTES * resolution**2
    return min(_MOST_CHILDREN, max(1, int(_USED * memory_bytes) // child_bytes))
