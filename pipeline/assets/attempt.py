"""What one method makes of an object: the answer of a child, read without any mesh library."""

from collections.abc import Mapping
from dataclasses import dataclass

from storage.records.asset import Asset


@dataclass(frozen=True, kw_only=True, eq=False)
class AssetAttempt:
    """What one method made of an object."""

    method: str
    """The one that was used: another than asked for where that one is not safe for the mesh."""
    asset: Asset
    """With the levels that passed the gate, possibly none."""
    missed: Mapping[int, tuple[str, str]]
    """Reason and message by budget, for the levels that did not."""
    unread: tuple[str, ...] = ()
    """What of the file no code has read, in short sentences."""
