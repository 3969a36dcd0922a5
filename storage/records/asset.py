"""`Asset`: one object as clean triangle meshes at several budgets, in one safetensors file.

The file holds, per level, `positions_<budget>` f32 [V, 3] and `faces_<budget>` u32 [F, 3], and in
its metadata what is known of the source and of each level. Positions are in the unit box: the
bounding box of the cleaned source is centred on the origin and its longest side is 1. Where objects
keep their own materials it holds their skins too; otherwise not a byte more. A skin's textures are
an atlas of the level's own triangles, baked from the source (pipeline.assets.source_materials), so
that they need no charts and survive any change of the triangles. Each is packed as in a shard
(storage.records.packed_maps), since a run holds many objects and shows few of them at a time.

`AssetRow` is what `trilight assets` reports of one object. The rows of the accepted objects are a
catalogue (`objects.jsonl`), so that the output folder is itself a source of objects.
"""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from storage.errors import TrilightError
from storage.records.objects import NamedObject
from storage.records.packed_maps import unpack_texture
from storage.records.safe_read import read_safetensors
from storage.records.texture import NORMAL, TEXTURED, Texture
from storage.typed_json import read_json

SkinTextures = tuple[Texture, Texture, Texture]
"""Diffuse, specular and roughness; one texel in float32 where one is the same everywhere."""


@dataclass(frozen=True, kw_only=True)
class SkinQuality:
    """Color errors of a level against its source."""

    colour_error: float
    """Mean difference of the linear diffuse colour between points spread evenly over the source and
    the nearest points of the level, over all channels."""
    colour_error_p95: float
    missed_cells: float
    """Share of the texels for which the source has no surface nearby that faces the same way: they
    show its nearest point."""
    torn_seams: float
    """Share of the length of inner edges whose two sides show places of the source that are more
    than two texels apart."""
    texels_per_length: float
    """Texels along the longest side of the object's bounding box."""


@dataclass(frozen=True, kw_only=True)
class OwnMaterials:
    """Result of reading a source's materials."""

    reason: str = ""
    """Stable code of why the object goes without them; empty where it has them."""
    message: str = ""
    lost: tuple[str, ...] = ()
    """Properties of the source that this renderer cannot show, such as `emission`."""

    @property
    def see_through(self) -> tuple[str, ...]:
        """Those of `lost` by which light passes through surfaces, which are opaque here."""
        return tuple(word for word in self.lost if word in ("transmission", "transparency"))


@dataclass(frozen=True, kw_only=True, eq=False)
class LevelSkin:
    """The look of one level."""

    uv: NDArray[np.float32]
    """[F, 3, 2] texture coordinates of each corner of each face, within [0, 1], v up."""
    packed: Mapping[str, bytes]
    """Encoded bytes of the textures by name: TEXTURED, and NORMAL where the source has a normal map
    and it was requested."""
    quality: SkinQuality
    emission: NDArray[np.float32] | None = None
    """[F, 3] what each face emits, in the units of the source; None where nothing does, or
    where it was not requested."""

    @cached_property
    def textures(self) -> SkinTextures:
        """Diffuse, specular and roughness, unpacked."""
        first, second, third = (unpack_texture(self.packed[name], name) for name in TEXTURED)
        return first, second, third

    @cached_property
    def normal(self) -> Texture | None:
        """The normal map, unpacked."""
        return unpack_texture(self.packed[NORMAL], NORMAL) if NORMAL in self.packed else None

    @property
    def num_bytes(self) -> int:
        """Bytes as they are stored."""
        glow = 0 if self.emission is None else self.emission.nbytes
        return self.uv.nbytes + sum(map(len, self.packed.values())) + glow


@dataclass(frozen=True, kw_only=True)
class SourceFacts:
    """Measures of the source file, and the effects of cleaning."""

    num_faces_read: int
    """Triangles as the file has them, instances counted."""
    num_faces: int
    """Triangles after cleaning: without degenerate and repeated ones."""
    num_faces_turned: int
    """Triangles whose winding was reversed to face outward."""
    num_parts: int
    open_edges: int
    """Edges with one face; 0 for a surface without border."""
    nonmanifold_edges: int
    """Edges with three faces or more."""
    front_share: float
    """Share of rays from outside that meet a front: near 1 where there is an outside."""

    @property
    def watertight(self) -> bool:
        """True: every edge has exactly two faces."""
        return self.open_edges == 0 and self.nonmanifold_edges == 0

    @property
    def repaired(self) -> bool:
        """True: triangles were dropped or flipped."""
        return self.num_faces < self.num_faces_read or self.num_faces_turned > 0


@dataclass(frozen=True, kw_only=True)
class LevelQuality:
    """Distances of a level from the cleaned source, and the quality of its triangles.

    Distances are shares of the diagonal of the source's bounding box, and the larger of the two
    directions.
    """

    error_mean: float
    error_p99: float
    """99th percentile of the distance: what bounds refer to."""
    error_max: float
    normal_error_deg: float
    """Mean angle between the normals of the source and of the level, 0 to 90."""
    area_ratio: float
    """Area as a multiple of the source's."""
    silhouette_iou: float
    """Agreement of the outlines over several directions, 0 to 1."""
    lost_area: float
    """Share of the source's area in parts that have vanished."""
    area_variation: float
    """Standard deviation of the triangles' areas over their mean."""
    min_angle_p5_deg: float
    """5th percentile of the triangles' smallest angles."""
    open_edges: int


@dataclass(frozen=True, kw_only=True)
class LevelRecord:
    """Method of one level, and its distance from the source."""

    budget: int
    """The most triangles that the level was allowed."""
    method: str
    """`source` (within budget as it was), or the name of the decimation; after `capped`, `solid` or
    `hollow` where the mesh was made watertight."""
    quality: LevelQuality


@dataclass(frozen=True, kw_only=True, eq=False)
class Level:
    """One mesh of an asset."""

    record: LevelRecord
    positions: NDArray[np.float32]
    """[V, 3] in the unit box."""
    faces: NDArray[np.uint32]
    """[F, 3], counter-clockwise from outside where the source has an outside."""
    skin: LevelSkin | None = None
    """Textures of the source's materials; None where they are not kept."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Facts:
    """Facts of an asset, and of the metadata of its file."""

    geometry_sha256: str
    """Digest of the cleaned source geometry: equal for copies, whatever their names."""
    source_sha256: str
    recipe: str
    """Name and version of the recipe and of the libraries that made it."""
    source: SourceFacts
    materials: OwnMaterials | None = None
    """Result of reading the source's materials; None where they were not requested."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Asset(_Facts):
    """A clean object at falling budgets."""

    levels: tuple[Level, ...]
    """Levels of detail, the largest triangle budget first."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Header(_Facts):
    levels: tuple[LevelRecord, ...]
    skins: Mapping[str, SkinQuality] = dataclasses.field(default_factory=dict)
    """Quality of the skin of each level that has one, by its budget."""


def encode_asset(asset: Asset) -> bytes:
    """Return the file of an asset; equal assets give equal bytes."""
    arrays: dict[str, NDArray] = {}
    for level in asset.levels:
        of_level: dict[str, NDArray | None] = {"positions": level.positions, "faces": level.faces}
        if (skin := level.skin) is not None:
            of_level |= {name: np.frombuffer(data, np.uint8) for name, data in skin.packed.items()}
            of_level |= {"uv": skin.uv, "emission": skin.emission}
        for name, array in of_level.items():
            if array is not None:
                arrays[f"{name}_{level.record.budget}"] = np.ascontiguousarray(array)
    skins = {str(each.record.budget): each.skin.quality for each in asset.levels if each.skin}
    facts = {field.name: getattr(asset, field.name) for field in dataclasses.fields(_Facts)}
    levels = tuple(level.record for level in asset.levels)
    header = dataclasses.asdict(_Header(**facts, levels=levels, skins=skins))
    if asset.materials is None:
        del header["materials"], header["skins"]
    return save(arrays, metadata={"asset": json.dumps(header, sort_keys=True)})


def decode_asset(data: bytes) -> Asset:
    """Return the asset of a file.

    Raises:
        TrilightError: the file is damaged, or another kind of safetensors file.
    """
    arrays, metadata = read_safetensors(data)
    try:
        header = read_json(metadata.get("asset", ""), _Header, "its header")
        levels = tuple(_level(record, header.skins, arrays) for record in header.levels)
    except (KeyError, TrilightError) as error:
        raise TrilightError(
            f"asset: a safetensors file with arrays {', '.join(arrays) or 'none'} does not hold "
            f"one ({error}); expected a file of the asset store. Delete it: it is made again."
        ) from error
    facts = {field.name: getattr(header, field.name) for field in dataclasses.fields(_Facts)}
    return Asset(**facts, levels=levels)


def _level(
    record: LevelRecord, skins: Mapping[str, SkinQuality], arrays: Mapping[str, NDArray]
) -> Level:
    end = f"_{record.budget}"
    of_level = {name.removesuffix(end): each for name, each in arrays.items() if name.endswith(end)}
    skin = None
    if (quality := skins.get(str(record.budget))) is not None:
        names = (*TEXTURED, NORMAL) if NORMAL in of_level else TEXTURED
        skin = LevelSkin(
            uv=of_level["uv"],
            packed={name: of_level[name].tobytes() for name in names},
            quality=quality,
            emission=of_level.get("emission"),
        )
    return Level(record=record, positions=of_level["positions"], faces=of_level["faces"], skin=skin)


@dataclass(frozen=True, kw_only=True)
class AssetRow(NamedObject):
    """An accepted object."""

    path: str
    """Path of the mesh, relative to the folder."""
    num_faces: int
    method: str
    """How it was made; `source` where nothing had to be left out."""
    quality: LevelQuality
    source: SourceFacts
    materials: OwnMaterials | None = None
    """Result of reading the source's materials; None where they were not requested."""
    colours: SkinQuality | None = None
    """How the colours of the mesh compare with the source's; None where it has none of its own."""

    def as_json(self) -> dict[str, Any]:
        """Return the row as JSON values, with the two judgements that readers ask for."""
        row = dataclasses.asdict(self)
        for name in ("materials", "colours"):
            if row[name] is None:
                del row[name]
        row["repaired"] = self.source.repaired
        row["source"]["watertight"] = self.source.watertight
        return row
