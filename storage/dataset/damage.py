"""What is said of a shard that cannot be read, whatever of it is wrong."""

import contextlib
import shlex
import zlib
from collections.abc import Iterator

from storage.errors import TrilightError

_OF_DAMAGED_BYTES = (ValueError, LookupError, TypeError, EOFError, zlib.error)


@contextlib.contextmanager
def reading(dataset: str, shard: str) -> Iterator[None]:
    """Turn whatever the bytes of a shard lead to into one sentence with the next step.

    Args:
        dataset: where it is, for people.
        shard: the name.

    Raises:
        TrilightError: the block raised one, or any error that damaged bytes may lead to.
    """
    try:
        yield
    except _OF_DAMAGED_BYTES as error:
        why = (
            str(error)
            if isinstance(error, TrilightError)
            else f"not as expected ({type(error).__name__})"
        )
        raise TrilightError(
            f"{shard}: {why.rstrip('.')}. The shard is damaged; run `trilight verify "
            f"{shlex.quote(dataset)} --repair`."
        ) from error
