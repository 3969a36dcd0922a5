"""What to do about data that is damaged: stop and name it, or count it and go on to a limit."""

import threading
from collections.abc import Sequence

from storage.errors import TrilightError


class Unusable:
    """The damaged samples and shards that a process has met."""

    def __init__(self, most: int) -> None:
        """Remember the limit.

        Args:
            most: samples that may be unusable; at 0 the first one ends the run.
        """
        self.most = most
        self._found: dict[str, int] = {}
        self._messages: list[str] = []
        self._lock = threading.Lock()

    @property
    def messages(self) -> Sequence[str]:
        """What was wrong, once for each sample or shard."""
        return tuple(self._messages)

    def add(self, name: str, num_samples: int, error: TrilightError) -> None:
        """Count something unusable, once however often it is met.

        Args:
            name: of the sample or shard.
            num_samples: how many samples are lost with it.
            error: what is wrong with it; names it.

        Raises:
            TrilightError: `error`, or that there are more than `most`.
        """
        if not self.most:
            raise error
        with self._lock:
            if name not in self._found:
                self._found[name] = num_samples
                self._messages.append(str(error))
            count = sum(self._found.values())
        if count > self.most:
            raise TrilightError(
                f"data: {count} samples are unusable; expected at most {self.most}. The last: "
                f"{error}"
            ) from error
