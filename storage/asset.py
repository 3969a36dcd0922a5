"""`Asset`: one object as clean triangle meshes at several budgets, in one safetensors file.

The file holds, per level, `positions_<budget>` f32 [V, 3] and `faces_<budget>` u32 [F, 3], and in
its metadata the record of how the level was made. Positions are in the unit box: the bounding box
of the cleaned source is centred on the origin and its longest side is 1.
"""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from storage.safe_read import read_safetensors


@dataclass(frozen=True, kw_only=True)
class LevelRecord:
    """How one level was made, and how far it is from the source."""

    budget: int
    """The most triangles that the level was allowed."""
    method: str
    """`source` (within budget as it was), or the name of the decimation."""
    error_p99: float
    """Two-way distance to the cleaned source, 99th percentile, as a share of the box diagonal."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Level:
    """One mesh of an asset."""

    record: LevelRecord
    """How it was made."""
    positions: NDArray[np.float32]
    """[V, 3] in the unit box."""
    faces: NDArray[np.uint32]
    """[F, 3], counter-clockwise from outside where the source has an outside."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Asset:
    """A clean object at falling budgets."""

    geometry_sha256: str
    """Digest of the cleaned source geometry: equal for copies, whatever their names."""
    source_sha256: str
    """Digest of the source file."""
    recipe: str
    """Name and version of the recipe and of the libraries that made it."""
    levels: tuple[Level, ...]
    """From the largest budget to the smallest."""

    def finest_within(self, num_triangles: int) -> Level | None:
        """Return the finest level of at most `num_triangles` faces, or None."""
        fitting = [level for level in self.levels if len(level.faces) <= num_triangles]
        return max(fitting, key=lambda level: len(level.faces), default=None)


def encode_asset(asset: Asset) -> bytes:
    """Return the file of an asset; equal assets give equal bytes."""
    arrays: dict[str, NDArray] = {}
    for level in asset.levels:
        arrays[f"positions_{level.record.budget}"] = np.ascontiguousarray(level.positions)
        arrays[f"faces_{level.record.budget}"] = np.ascontiguousarray(level.faces)
    header = {
        "geometry_sha256": asset.geometry_sha256,
        "source_sha256": asset.source_sha256,
        "recipe": asset.recipe,
        "levels": [dataclasses.asdict(level.record) for level in asset.levels],
    }
    return save(arrays, metadata={"asset": json.dumps(header, sort_keys=True)})


def decode_asset(data: bytes) -> Asset:
    """Return the asset of a file; raises TrilightError where it is not one."""
    arrays, metadata = read_safetensors(data)
    header = json.loads(metadata["asset"])
    records: Sequence[LevelRecord] = [LevelRecord(**row) for row in header.pop("levels")]
    levels = tuple(
        Level(
            record=record,
            positions=arrays[f"positions_{record.budget}"],
            faces=arrays[f"faces_{record.budget}"],
        )
        for record in records
    )
    return Asset(levels=levels, **header)
