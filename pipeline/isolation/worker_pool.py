"""`ChildPool`: a pool of worker processes, lent to one task at a time."""

import contextlib
import queue
from collections.abc import Callable, Iterator

from pipeline.isolation.child import IsolatedChild


class ChildPool:
    """At most `size` children, each with its compiled kernels warm for the next task."""

    def __init__(self, make_child: Callable[[int], IsolatedChild], size: int) -> None:
        """Make the children; each starts its process when it is first called.

        Args:
            make_child: called with the number of each child, from 0.
            size: number of children.
        """
        self._children = [make_child(number) for number in range(size)]
        self._free: queue.SimpleQueue[IsolatedChild] = queue.SimpleQueue()
        for child in self._children:
            self._free.put(child)
        self.num_users = 0
        """Number of tasks that use the pool; counted by the owner of several pools."""

    @contextlib.contextmanager
    def borrow(self) -> Iterator[IsolatedChild]:
        """Lend a free child; wait while all are lent."""
        child = self._free.get()
        try:
            yield child
        finally:
            self._free.put(child)

    def close(self) -> None:
        """End all children at once."""
        for child in self._children:
            child.close()
