"""Many cases of one law in one test: a failure names its case."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def case(name: object) -> Iterator[None]:
    """Name the case in whatever a test fails with."""
    try:
        yield
    except BaseException as failure:
        failure.add_note(f"in the case {name!r}")
        raise
