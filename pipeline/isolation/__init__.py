"""Child processes that we own: native code may crash, hang or eat memory there, and costs one item.

- `child`: the owner's side: children are started, called, replaced and ended.
- `inside`: the child's side: it keeps its limits and never outlives its owner.
- `waiting`: for an answer, without punishing a child for a pause of the whole command.
- `confinement`: what a child may reach that reads strangers' files, by `landlock` and `seccomp`.
- `deaths`: what can end a call, how often it is tried again, and which ends are verdicts.
"""

from pipeline.isolation.child import (
    ChildClosed,
    ChildLimits,
    IsolatedChild,
    call_with_retries,
    preload,
)
from pipeline.isolation.confinement import NO_FILES, Reach, reach
from pipeline.isolation.deaths import ChildFailed, Result, is_passing, with_retries
from pipeline.isolation.inside import die_with_parent

__all__ = [
    "ChildClosed",
    "ChildFailed",
    "ChildLimits",
    "IsolatedChild",
    "NO_FILES",
    "Reach",
    "Result",
    "call_with_retries",
    "die_with_parent",
    "is_passing",
    "preload",
    "reach",
    "with_retries",
]
