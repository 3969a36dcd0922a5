"""Selects the objects of a scene that keep the materials of their source, and makes their skins."""

import dataclasses
from collections.abc import Sequence

from pipeline.scenes.pieces import Skin
from pipeline.scenes.pool import PooledAsset
from scene_templates.materials import MaterialSettings
from storage.errors import Rejected, TrilightError
from storage.records.asset import Level
from storage.records.objects import LockedObject
from storage.records.skin import LevelSkin
from storage.records.texture import TEXTURED, MapSource
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
        chosen: the objects of a scene.
        levels: the level of detail of each.
        settings: source of the materials, and the fraction of objects that keep theirs.
        scene_key: seed, index and attempt of the scene.

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
        textures = skin.textures
    except TrilightError as error:
        raise Rejected("law_broken", f"object {locked.uid}: {error}") from error
    first, second, third = (
        dataclasses.replace(
            texture,
            source=MapSource(
                name=f"{locked.uid} {column}",
                licence=locked.licence,
                attribution=locked.attribution,
                source_url=locked.source_url,
            ),
        )
        for texture, column in zip(textures, TEXTURED, strict=True)
    )
    return Skin(uv=skin.uv.reshape(-1, 2), textures=(first, second, third), emission=skin.emission)
