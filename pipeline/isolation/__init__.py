"""Child processes for native code: a crash, a hang or a memory leak costs one item, not the run.

- `child`: the owner's side: starts, calls, replaces and ends children.
- `worker_pool`: the children, worker processes, that tasks share.
- `child_main`: the child's side: applies its limits and never outlives its owner.
- `waiting`: waits for an answer; a pause of the whole command does not count as time.
- `confinement`: restricts children that read untrusted files, by `landlock` and `seccomp`.
- `call_failures`: the ways a call can fail, the number of retries, and which failures are verdicts.
"""

from pipeline.isolation.call_failures import ChildFailed, Result, is_transient, with_retries
from pipeline.isolation.child import (
    ChildClosed,
    ChildLimits,
    IsolatedChild,
    call_with_retries,
    preload,
)
from pipeline.isolation.child_main import die_with_parent
from pipeline.isolation.confinement import NO_FILES, Reach, reach
from pipeline.isolation.worker_pool import ChildPool

__all__ = [
    "ChildClosed",
    "ChildFailed",
    "ChildLimits",
    "ChildPool",
    "IsolatedChild",
    "NO_FILES",
    "Reach",
    "Result",
    "call_with_retries",
    "die_with_parent",
    "is_transient",
    "preload",
    "reach",
    "with_retries",
]
