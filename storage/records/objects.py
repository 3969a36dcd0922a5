"""What one stage hands to the next: rows of plain values, each with the rights of its object."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ObjectRecord:
    """One 3D object as it was found: a readable file and the rights to it."""

    uid: str
    """Unique in its source, and stable: it names the object in every later record."""
    path: str
    """The file, absolute, on this machine; never published."""
    title: str
    """For people."""
    licence: str
    """SPDX identifier, or `LicenseRef-...`."""
    licence_source: str
    """Where the licence is stated, and as of when; for the record of rights."""
    attribution: str
    """Whom to name, as the source states it."""
    source_url: str
    """Where the object came from."""


@dataclass(frozen=True, kw_only=True)
class LockedObject:
    """One accepted object of a dataset, as `objects.lock.jsonl` freezes it."""

    uid: str
    """As in ObjectRecord."""
    asset_sha256: str
    """Digest of the prepared asset file: the exact triangles that scenes use."""
    split: str
    """train, validation or test, by a hash of the cleaned geometry: copies stay together."""
    licence: str
    """SPDX identifier, or `LicenseRef-...`."""
    licence_source: str
    """Where the licence is stated, and as of when."""
    title: str
    """For people."""
    attribution: str
    """Whom to name."""
    source_url: str
    """Where the object came from."""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """One row of `failures.jsonl`: what was rejected, where, and why."""

    stage: str
    """objects, assets, scenes or renders."""
    item: str
    """uid of the object or key of the scene (with `.view` where a view was rejected)."""
    reason: str
    """Stable code in snake_case."""
    message: str
    """One sentence for a person."""
    attempt: int = 0
    """Which attempt at the item this was, from 0."""
