"""Repair of a local dataset: makes exactly its missing or bad shards again."""

import contextlib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import cast

from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.executors.threads import ThreadRunner
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.pipeline import make_dataset, prepare_dataset
from pipeline.objects.licences import BY_USER
from pipeline.presets.registry import preset_settings
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.manifest import Manifest, derivation_of
from storage.dataset.progress import read_asked, value_of
from storage.errors import TrilightError
from storage.extensions import extension_digests, require_same_extensions
from storage.records.objects import OBJECT, SKY, TEXTURE
from storage.remote.url import parse_url
from storage.settings.described import settings_record
from storage.settings.overrides import differences

ASIDE = ".bad"
"""Suffix of a bad shard until its replacement is finished."""

_OF_SCENE_FILES = ("scenes.num_views", "splits.listed_scenes", "splits.one_split")
"""Settings that follow from the scene files, so that they must not be stated with them."""


def repair(
    dataset: str, bad_shards: Sequence[str], *, objects: str | None, scenes_from: str | None
) -> None:
    """Set bad shards aside and generate them again from the settings of the manifest.

    Intact shards stay exactly as they are. The bad files are deleted at the end; if the generation
    fails, those without a replacement are put back.

    Args:
        bad_shards: names of the shards (storage.dataset.verify).
        objects: source of objects; None: that of the `generate` command.
        scenes_from: folder of the scene files, as in the `generate` command; their digests are in
            the lock, so that no other files are accepted.

    Raises:
        TrilightError: the dataset is on a server, was derived from other datasets, or was begun in
            another environment; objects or scene files are missing or differ, and then no shard
            is moved; or the generated shards differ from the manifest.
    """
    root = parse_url(dataset, what="dataset")
    if not isinstance(root, Path):
        raise TrilightError(
            f"dataset {root.display_url!r} is on a server; expected a folder to repair. Repair the "
            "folder that it was copied from."
        )
    opened = open_dataset(str(root))
    manifest = opened.manifest
    _require_generated(manifest, scenes_from)
    require_same_extensions(str(root), manifest.extensions, extension_digests("data"))
    command = read_asked(opened) or ()
    revisits = _revisit_source(opened, command)
    lock = opened.objects_lock()
    stated = [each for each in lock if each.kind == OBJECT and each.licence_source == BY_USER]
    maps = _user_maps(opened, {entry.kind for entry in lock}, command)
    options = GenerateOptions(
        build=manifest.build,
        objects=None if scenes_from or revisits else objects or value_of(command, "--objects"),
        out=str(root),
        scenes=None if scenes_from or revisits else manifest.num_scenes,
        licence=stated[0].licence if stated else None,  # it applied to all objects
        textures=maps.get("textures"),
        skies=maps.get("skies"),
        map_licence=maps.get("map_licence"),
        scenes_from=scenes_from,
        revisits=revisits,
        views=manifest.num_views if scenes_from else None,
        albedo_over_one=cast(AlbedoOverOne, value_of(command, "--albedo-over-one") or "scale"),
        changes=_changes(manifest),
    )
    prepare_dataset(options)  # refuses other objects before a shard is moved
    with _set_aside(root, bad_shards):
        outcome = make_dataset(options, ThreadRunner())
        if outcome.digest != manifest.dataset_digest:
            raise TrilightError(
                f"{root}: the shards were made again, but the dataset digest is {outcome.digest}; "
                f"expected {manifest.dataset_digest}. The bad ones are kept as *.tar{ASIDE}."
            )


@contextlib.contextmanager
def _set_aside(root: Path, bad_shards: Sequence[str]) -> Iterator[None]:
    """Rename bad shards, and delete them at the end; put back what an error left unreplaced."""
    renamed = {root / name: root / f"{name}{ASIDE}" for name in bad_shards}
    for path, aside in renamed.items():
        if path.exists():
            path.replace(aside)
    try:
        yield
    except TrilightError:
        for path, aside in renamed.items():
            if aside.exists() and not path.exists():
                aside.replace(path)
        raise
    for aside in renamed.values():
        aside.unlink(missing_ok=True)


def _require_generated(manifest: Manifest, scenes_from: str | None) -> None:
    """Refuse a dataset that `generate` cannot make again with these arguments."""
    if (derivation := derivation_of(manifest.settings)) is not None:
        raise TrilightError(
            f"the dataset was made by `trilight shards {derivation.operation}`; expected one of "
            "`trilight generate`. Make it again from its sources: the bytes will be the same."
        )
    of_files = _is_of_files(manifest)
    if of_files and scenes_from is None:
        raise TrilightError(
            f"preset {manifest.build!r} was made from scene files; expected --scenes-from FOLDER, "
            "the folder that it was made from."
        )
    if scenes_from is not None and not of_files:
        raise TrilightError(
            f"--scenes-from is {scenes_from}, but the dataset draws its scenes; expected it only "
            "for one that was made with it."
        )


def _is_of_files(manifest: Manifest) -> bool:
    settings = manifest.settings
    return settings["splits"].get("listed_scenes") is not None and "revisit" not in settings


def _revisit_source(dataset: Dataset, command: Sequence[str]) -> str | None:
    """Return the folder of the dataset that was revisited, from `logs/asked.json`."""
    settings = dataset.manifest.settings
    if "revisit" not in settings:
        return None
    if (place := value_of(command, "--revisits")) is None:
        digest = settings["revisit"]["source_digest"]
        raise _forgotten(dataset, f"are those of the dataset {digest}", "revisit")
    return place


def _forgotten(dataset: Dataset, scenes: str, command: str) -> TrilightError:
    return TrilightError(
        f"{dataset.display_name}: its scenes {scenes}, and logs/asked.json does not say where that "
        f"is. Delete the bad shards, and run the same `trilight {command}` again."
    )


def _user_maps(
    dataset: Dataset, kinds: Collection[str], command: Sequence[str]
) -> dict[str, str | None]:
    """Return the user's folders of textures and sky maps, from `logs/asked.json`.

    Raises:
        TrilightError: the dataset uses such maps, and the file does not name their folder.
    """
    options = {TEXTURE: "textures", SKY: "skies"}
    folders: dict[str, str | None] = {
        name: value_of(command, f"--{name}") for kind, name in options.items() if kind in kinds
    }
    if None in folders.values():
        raise _forgotten(dataset, "have textures or maps of a folder", "generate")
    return folders | ({"map_licence": value_of(command, "--map-licence")} if folders else {})


def _changes(manifest: Manifest) -> dict[str, object]:
    """Return the settings of a dataset that differ from its preset's."""
    build = settings_record(preset_settings(manifest.build))
    changed = {name: now for name, _, now in differences(build, manifest.settings)}
    if _is_of_files(manifest):
        return {name: now for name, now in changed.items() if name not in _OF_SCENE_FILES}
    return changed
