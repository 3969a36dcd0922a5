"""The result of one decimation method: a child process's answer, free of mesh libraries."""

from collections.abc import Mapping
from dataclasses import dataclass

from storage.records.asset import Asset


@dataclass(frozen=True, kw_only=True, eq=False)
class AssetAttempt:
    """The result of one decimation method for one object."""

    method: str
    """Method that ran: `meshoptimizer` where the requested one is unsafe for this mesh."""
    asset: Asset
    """The asset, with the levels that passed the quality checks; possibly none."""
    missed: Mapping[int, tuple[str, str]]
    """Reason code and message by budget, for the levels that failed."""
    unread: tuple[str, ...] = ()
    """Short sentences, one for each part of the file that no reader handled."""
