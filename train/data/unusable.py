"""What to do about data that is damaged: stop and name it, or count it and go on to a limit.

The count belongs to the run: a checkpoint keeps it, so that whoever resumes often is allowed no
more than whoever never stops. What was met is kept by a digest of its name, since names of listed
shards may be paths of a user's machine.
"""

import threading
from collections.abc import Mapping, Sequence

from storage.digests import sha256_hex
from storage.errors import TrilightError


class Unusable:
    """The damaged samples and shards that a run has met."""

    def __init__(self, most: int, met: Mapping[str, int] | None = None) -> None:
        """Remember the limit.

        Args:
            most: samples that may be unusable; at 0 the first one ends the run.
            met: what `met` gave, of the part of the run that is resumed.
        """
        self.most = most
        self._met: dict[str, int] = dict(met or {})
        self._messages: dict[str, str] = {}
        self._lock = threading.Lock()

    @property
    def messages(self) -> Sequence[str]:
        """What was wrong, once for each sample or shard that this process has met."""
        return tuple(self._messages.values())

    @property
    def met(self) -> Mapping[str, int]:
        """Samples that are lost, by a digest of what they are lost with."""
        with self._lock:
            return dict(sorted(self._met.items()))

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
            self._met.setdefault(sha256_hex(name.encode())[:16], num_samples)
            self._messages.setdefault(name, str(error))
            count = sum(self._met.values())
        if count > self.most:
            raise TrilightError(
                f"data: {count} samples are unusable; expected at most {self.most}. The last: "
                f"{error}"
            ) from error
