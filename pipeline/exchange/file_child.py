"""The child process that reads a user's scene files: meshes, stages and shards of any origin."""

from pipeline.isolation import ChildLimits, IsolatedChild

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=1800, calls_per_child=1000)


def file_child() -> IsolatedChild:
    """Return a child with limits that nothing was set up in; close it."""
    return IsolatedChild(limits=_LIMITS, setup=_no_set_up)


def _no_set_up() -> None:
    pass
