"""Child processes for native code: a crash, a hang or a memory leak costs one item, not the run.

- `child`: the owner's side: starts, calls, replaces and ends children, and lends them to tasks; and
  the child's side: applies its limits and never outlives its owner.
- `answers`: messages; waits for one, and a pause of the whole command does not count as time.
- `confinement`: restricts children that read untrusted files, by `system_calls`.
- `call_failures`: the ways a call can fail, the number of retries, and which failures are verdicts.
"""

from pipeline.isolation.call_failures import ChildFailed as ChildFailed
from pipeline.isolation.call_failures import Result as Result
from pipeline.isolation.call_failures import is_transient as is_transient
from pipeline.isolation.call_failures import with_retries as with_retries
from pipeline.isolation.child import ChildClosed as ChildClosed
from pipeline.isolation.child import ChildLimits as ChildLimits
from pipeline.isolation.child import ChildPool as ChildPool
from pipeline.isolation.child import IsolatedChild as IsolatedChild
from pipeline.isolation.child import call_with_retries as call_with_retries
from pipeline.isolation.child import die_with_parent as die_with_parent
from pipeline.isolation.child import preload as preload
from pipeline.isolation.confinement import NO_FILES as NO_FILES
from pipeline.isolation.confinement import Reach as Reach
from pipeline.isolation.confinement import reach as reach
