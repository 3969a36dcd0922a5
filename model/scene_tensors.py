"""Conversion of scenes to tensors, for training and inference.

Shape suffixes here and in all of `model`:
    B scenes of a batch      V views of a scene      T triangles (padded to the longest of a batch)
    N tokens of a scene = registers + T              Q ray bundles of a picture
    W token width   H heads   D width of a head      R pixels across a picture, P across a bundle
    A rotary angles of a position                    3 x, y, z or r, g, b
    M numbers of a material, of the columns that the network reads: 10 of the published ones

A batch holds scenes of similar length and is padded to the longest of them, never to a constant;
the padding is zero, because a mask hides finite values but not NaN (0 * NaN is NaN).
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from model.hits.textures import SurfaceTextures, surface_textures
from model.hits.traced import Traced, stack_traced
from storage.conventions import log10_radiance
from storage.errors import TrilightError
from storage.records.material import PUBLISHED_COLUMNS, chosen_columns, column_places, laid_out
from storage.records.scene import Scene
from storage.records.texture import Environment

if TYPE_CHECKING:  # it loads pydantic
    from model.config import ModelConfig

MAX_NETWORK_M = 1000.0
"""Farthest vertex coordinate that a network reads. At 11 radians per metre, float32 knows rotary
angles so far out to half a thousandth of a radian; far beyond, pictures are wrong."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneTensors:
    """Input of the network for one scene; float32 unless converted."""

    triangles_T33: Tensor
    """Vertices of each triangle, world space, meters."""
    normals_T33: Tensor
    """Unit shading normals at those vertices, world space."""
    material_TM: Tensor
    """Values of the material columns, log10(1 + x) in log-encoded ones."""
    c2w_V44: Tensor
    """Camera-to-world matrix of each view."""
    fov_deg_V: Tensor
    """Full field of view in degrees."""
    columns: tuple[str, ...] = PUBLISHED_COLUMNS
    """Names of the columns of `material_TM`, in order (storage.records.material)."""
    traced: Traced | None = None
    """Traced inputs of these views, for the view stage `hits`; if None, the network traces them."""
    albedo_VRR6: Tensor | None = None
    """Albedo of visible surfaces, for a demodulated network; if None, the network computes it
    (model.hits.tracing)."""
    textures: SurfaceTextures | None = None
    """Textures that replace material columns at each hit; `material_TM` holds their means. None
    without textures."""
    sky: Environment | None = None
    """Environment light; None if there is none or it is black."""

    @property
    def num_triangles(self) -> int:
        return len(self.triangles_T33)

    @property
    def num_views(self) -> int:
        return len(self.c2w_V44)


@dataclass(frozen=True, kw_only=True, eq=False)
class Cameras:
    """Cameras of a batch of scenes, with equal numbers of views; fields as in SceneTensors."""

    c2w_BV44: Tensor
    fov_deg_BV: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneBatch(Cameras):
    """Scenes of equal view count, padded with zeros to the longest; fields as in SceneTensors."""

    triangles_BT33: Tensor
    normals_BT33: Tensor
    material_BTM: Tensor
    is_triangle_BT: Tensor | None
    """bool, False in the padding; None without padding, so that attention needs no mask."""
    columns: tuple[str, ...] = PUBLISHED_COLUMNS
    num_triangles: tuple[int, ...] | None = None
    """Number of triangles of each padded scene; None without padding or if unknown."""
    traced: Traced | None = None
    """Traced inputs; None if any scene has none."""
    albedo_BVRR6: Tensor | None = None
    """Albedo of visible surfaces; None if any scene has none."""
    textures: tuple[SurfaceTextures | None, ...] | None = None
    """Textures of each scene; None if no scene has any."""
    skies: tuple[Environment | None, ...] | None = None
    """Environment light of each scene; None if no scene has any."""

    def material_of(self, columns: tuple[str, ...]) -> Tensor:
        """Return the material [B, T, M] with only these columns, in this order.

        Raises:
            TrilightError: the batch has no such column.
        """
        if columns == self.columns:
            return self.material_BTM
        columns_by_name = {column.name: part for column, part in laid_out(self.columns)}
        if missing := [name for name in columns if name not in columns_by_name]:
            raise TrilightError(
                f"scene: the network reads the material columns {', '.join(missing)}; the scene "
                f"has only {', '.join(self.columns)}."
            )
        return torch.cat(
            [self.material_BTM[..., columns_by_name[name]] for name in columns], dim=-1
        )


Mapped = TypeVar("Mapped")


def scene_tensors(scene: Scene, columns: tuple[str, ...] | None = None) -> SceneTensors:
    """Return the tensors of a scene that passes `Scene.check`; its arrays stay unchanged.

    Args:
        columns: material columns, such as those of one network (`ModelConfig.material_columns`);
            None for all declared columns.

    Raises:
        TrilightError: a vertex is farther than MAX_NETWORK_M from the origin along an axis, or a
            column is not declared.
    """
    farthest = np.abs(scene.vertex_positions).max()
    if not farthest <= MAX_NETWORK_M:  # also true for NaN
        raise TrilightError(
            f"scene: a vertex stands {farthest:g} m from the origin; the network reads up to "
            f"{MAX_NETWORK_M:g} m. Move the scene, with its cameras, towards the origin."
        )
    faces = scene.faces.astype(np.int64)
    if columns is None:
        columns = tuple(column_places())
    material = chosen_columns(scene.materials, columns)
    for column, part in laid_out(columns):
        if column.is_log_encoded:
            material[:, part] = log10_radiance(material[:, part])
    return SceneTensors(
        triangles_T33=torch.from_numpy(scene.vertex_positions[faces]),
        normals_T33=torch.from_numpy(scene.vertex_normals[faces]),
        material_TM=torch.from_numpy(material[scene.material_index]),
        c2w_V44=torch.from_numpy(scene.c2w.copy()),
        fov_deg_V=torch.from_numpy(scene.fov_deg.copy()),
        columns=columns,
        textures=surface_textures(scene),
        sky=lit_sky(scene.environment),
    )


def map_tensors(scenes: Mapped, convert: Callable[[Tensor], Tensor]) -> Mapped:
    """Return the same scenes, or what holds them, with each tensor converted, as to a device."""
    fields = {
        name: convert(each) if isinstance(each, Tensor) else map_tensors(each, convert)
        for name, each in vars(scenes).items()
        if isinstance(each, Tensor | SceneBatch | Traced)
    }
    return dataclasses.replace(scenes, **fields)  # type: ignore[type-var]


def in_light_units(batch: SceneBatch, unit_B3: Tensor) -> SceneBatch:
    """Return the batch with radiance in units [B, 3] of each scene: log10(1 + x / unit)."""
    material_BTM = batch.material_BTM.clone()
    for column, part in laid_out(batch.columns):
        if column.is_radiance and column.is_colour and column.is_log_encoded:
            radiance = torch.pow(10.0, material_BTM[..., part]) - 1
            material_BTM[..., part] = torch.log10(1 + radiance / unit_B3[:, None])
    return dataclasses.replace(batch, material_BTM=material_BTM)


def batch_scenes(scenes: Sequence[SceneTensors]) -> SceneBatch:
    """Collate scenes of equal view count and columns; a picture depends on its own scene alone."""
    assert all(scene.columns == scenes[0].columns for scene in scenes)
    lengths = [scene.num_triangles for scene in scenes]
    longest = max(lengths)
    padded = min(lengths) < longest
    traced = [scene.traced for scene in scenes if scene.traced is not None]
    albedo = [scene.albedo_VRR6 for scene in scenes if scene.albedo_VRR6 is not None]
    textures = tuple(scene.textures for scene in scenes)
    skies = tuple(scene.sky for scene in scenes)
    return SceneBatch(
        triangles_BT33=pad_sequence([scene.triangles_T33 for scene in scenes], True),
        normals_BT33=pad_sequence([scene.normals_T33 for scene in scenes], True),
        material_BTM=pad_sequence([scene.material_TM for scene in scenes], True),
        c2w_BV44=torch.stack([scene.c2w_V44 for scene in scenes]),
        fov_deg_BV=torch.stack([scene.fov_deg_V for scene in scenes]),
        is_triangle_BT=torch.arange(longest) < torch.tensor(lengths)[:, None] if padded else None,
        columns=scenes[0].columns,
        num_triangles=tuple(lengths) if padded else None,
        traced=stack_traced(traced) if len(traced) == len(scenes) else None,
        albedo_BVRR6=torch.stack(albedo) if len(albedo) == len(scenes) else None,
        textures=None if all(each is None for each in textures) else textures,
        skies=None if all(each is None for each in skies) else skies,
    )


def lit_sky(sky: Environment | None) -> Environment | None:
    """Return the environment, or None if it is missing or black."""
    return sky if sky is not None and sky.radiance_rgb.any() else None


def require_known_sky(sky: Environment | None, config: "ModelConfig") -> None:
    """Raise if a scene has a sky that the network does not support.

    Raises:
        TrilightError: the network has no input for a sky, or cameras see the sky directly, which no
            network renders.
    """
    if sky is None:
        return
    if not config.sky_rays:
        raise TrilightError(
            "scene: it has an environment, and this network does not know its light; expected "
            "none. Use a network of hits that knows skies (model.sky_rays=16), or scenes without "
            "one (scenes.skies.share=0)."
        )
    if sky.is_seen:
        raise TrilightError(
            "scene: cameras see its environment behind everything, which networks leave black; "
            "expected one that is not seen (scenes.skies.seen_share=0)."
        )
