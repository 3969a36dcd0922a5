"""Objects that keep the materials of their source, and lamps of what emits in them.

Files state radiance in arbitrary units. All emitting components of a scene are scaled by one
number, so that together they give the stated fraction of the power of the drawn lamps; by less if
the brightest of them would outshine the brightest lamp. Like every emitter they have the
reflectance of lamps, and the camera does not see them.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.scenes.pieces import ScenePiece, Skin, lamp_piece
from pipeline.scenes.shading_normals import face_crosses
from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.sample_material import MaterialSettings
from storage.errors import Rejected, TrilightError
from storage.records.asset import Level, LevelSkin
from storage.records.material import DIFFUSE, EMISSION
from storage.records.objects import LockedObject
from storage.records.scene import SceneObject
from storage.records.texture import NORMAL, TEXTURED, MapSource
from storage.seeds import SceneKey


def source_skins(
    chosen: Sequence[PooledAsset],
    levels: Sequence[Level],
    settings: MaterialSettings,
    scene_key: SceneKey,
) -> list[Skin | None]:
    """Return the skin of each object, or None if its materials are drawn.

    Each object has a random stream of its own, so that skins change no other draw of the scene, and
    another `own_share` changes none of the skins that stay.

    Args:
        settings: source of the materials, and the fraction of objects that keep theirs.

    Raises:
        Rejected: law_broken, which names the object.
    """
    if settings.source != "object":
        return [None] * len(chosen)
    skins: list[Skin | None] = []
    for row, (entry, level) in enumerate(zip(chosen, levels, strict=True)):
        rng = scene_key.rng("own materials", row)
        keeps = rng.random() < settings.own_share and level.skin is not None
        skins.append(_skin(level.skin, entry.locked) if keeps and level.skin else None)
    return skins


def _skin(skin: LevelSkin, locked: LockedObject) -> Skin:
    """Return a skin whose textures carry the rights of their object.

    Raises:
        Rejected: law_broken if the textures are invalid: an old version may have prepared them.
    """
    try:
        textures = [*skin.textures, *(() if skin.normal is None else (skin.normal,))]
    except TrilightError as error:
        raise Rejected("law_broken", f"object {locked.uid}: {error}") from error
    first, second, third, *normal = (
        dataclasses.replace(
            texture,
            source=MapSource(
                name=f"{locked.uid} {column}",
                licence=locked.licence,
                attribution=locked.attribution,
                source_url=locked.source_url,
            ),
        )
        for texture, column in zip(textures, (*TEXTURED, NORMAL), strict=False)
    )
    return Skin(
        uv=skin.uv.reshape(-1, 2),
        textures=(first, second, third),
        normal=normal[0] if normal else None,
        emission=skin.emission,
    )


def with_source_emission(
    objects: Sequence[ScenePiece], lamps: Sequence[ScenePiece], share: float
) -> tuple[list[ScenePiece], list[ScenePiece]]:
    """Return objects without their emitting triangles, and these as emitters.

    An object whose triangles all emit becomes an emitter in its place.

    Args:
        objects: pieces, some with skins that state the emission of their triangles.
        share: fraction of the lamps' power for all emitting triangles; 0 without lamps.
    """
    scale = _scale(objects, lamps, share)
    plain = [
        dataclasses.replace(piece, skin=dataclasses.replace(piece.skin, emission=None))
        if piece.skin
        else piece
        for piece in objects
    ]
    if scale == 0:
        return plain, []
    taken = {piece.entry.name for piece in [*objects, *lamps]}
    reflected = lamps[0].materials[0, DIFFUSE]
    emitters = []
    for row, piece in enumerate(objects):
        emission = _emission(piece)
        emits: NDArray[np.bool_] = np.asarray(emission.any(axis=1))
        if not emits.any():
            continue
        entry = _entry(piece.entry, taken)
        taken.add(entry.name)
        mesh = _part(plain[row], emits).mesh
        emitter = lamp_piece(entry, mesh, scale * emission[emits], reflected)
        if emits.all():
            plain[row] = emitter
        else:
            plain[row] = _part(plain[row], ~emits)
            emitters.append(emitter)
    return plain, emitters


def _scale(objects: Sequence[ScenePiece], lamps: Sequence[ScenePiece], share: float) -> float:
    emissions = [(_emission(piece).astype(np.float64), _areas(piece)) for piece in objects]
    power = sum(float(areas @ emission.mean(axis=1)) for emission, areas in emissions)
    brightest = max((float(emission.max(initial=0)) for emission, _ in emissions), default=0.0)
    if not (share and lamps and power > 0):
        return 0.0
    lit = [
        (lamp.materials[lamp.material_index, EMISSION].astype(np.float64), _areas(lamp))
        for lamp in lamps
    ]
    drawn = sum(float(areas @ radiance.mean(axis=1)) for radiance, areas in lit)
    greatest = max(float(radiance.max()) for radiance, _ in lit)
    return min(share * drawn / power, greatest / brightest)


def _part(piece: ScenePiece, chosen: NDArray[np.bool_]) -> ScenePiece:
    """Return some triangles of a piece, without vertices that they do not use."""
    used, faces = np.unique(piece.mesh.faces[chosen], return_inverse=True)
    mesh = dataclasses.replace(
        piece.mesh,
        positions=piece.mesh.positions[used],
        normals=piece.mesh.normals[used],
        faces=faces.reshape(-1, 3).astype(np.uint32),
        groups=piece.mesh.groups[chosen],
    )
    skin = piece.skin
    if skin is not None:
        skin = dataclasses.replace(skin, uv=skin.uv.reshape(-1, 3, 2)[chosen].reshape(-1, 2))
    return dataclasses.replace(
        piece, mesh=mesh, material_index=piece.material_index[chosen], skin=skin
    )


def _emission(piece: ScenePiece) -> NDArray[np.float32]:
    """Return the stated radiance of an object's triangles, [T, 3]."""
    stated = None if piece.skin is None else piece.skin.emission
    return np.zeros((len(piece.mesh.faces), 3), np.float32) if stated is None else stated


def _areas(piece: ScenePiece) -> NDArray[np.float64]:
    cross = face_crosses(piece.mesh.positions, piece.mesh.faces)
    return np.asarray(np.linalg.norm(cross, axis=1) / 2)


def _entry(of: SceneObject, taken: set[str]) -> SceneObject:
    names = (f"{of.name}_light{number or ''}" for number in range(len(taken) + 1))
    name = next(name for name in names if name not in taken)
    return dataclasses.replace(of, name=name, kind="emitter")
