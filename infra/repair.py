"""Repair: makes exactly the missing or bad shards of a local dataset again."""

from collections.abc import Sequence
from pathlib import Path
from typing import cast

from pipeline.builds.named import named_build
from pipeline.builds.settings import differences
from pipeline.exchange.from_description import AlbedoOverOne
from pipeline.executors.threads import ThreadRunner
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.pipeline import make_dataset
from pipeline.objects.licences import BY_USER
from storage.dataset.asked import read_asked, value_of
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.derived import derivation_of
from storage.dataset.manifest import Manifest
from storage.errors import TrilightError
from storage.extensions import recorded, require_same_extensions
from storage.records.objects import OBJECT, SKY, TEXTURE
from storage.remote.url import parse_url

ASIDE = ".bad"
"""Ends the name of a bad shard until its successor is there."""

_OF_SCENE_FILES = ("scenes.num_views", "splits.listed_scenes", "splits.one_split")
"""Settings that follow from the scene files, and are not to be given beside them."""


def repair(
    dataset: str, bad_shards: Sequence[str], *, objects: str | None, scenes_from: str | None
) -> None:
    """Set bad shards aside and have `generate` make them, from the settings of the manifest.

    Shards that are whole stay as they are, to the byte. The bad files are deleted at the end; where
    the making fails, they lie beside the dataset with the ending `.bad`.

    Args:
        dataset: folder of the dataset.
        bad_shards: their names (storage.dataset.verify).
        objects: where the objects come from, as it was said to `generate`.
        scenes_from: folder of the scene files, as it was said to `generate`; their digests are in
            the lock, so that no other files are taken.

    Raises:
        TrilightError: the dataset is on a server, was made of other datasets, or was begun in
            another environment; the scene files are lacking, or others; or what was made has other
            bytes than the manifest says.
    """
    root = parse_url(dataset, what="dataset")
    if not isinstance(root, Path):
        raise TrilightError(
            f"dataset {root.shown!r} is on a server; expected a folder to repair. Repair the "
            "folder that it was copied from."
        )
    opened = open_dataset(str(root))
    manifest = opened.manifest
    _require_generated(manifest, scenes_from)
    require_same_extensions(str(root), manifest.extensions, recorded("data"))
    changes = _changes(manifest)
    licence = _stated_licence(opened)
    asked = read_asked(opened) or ()
    revisits = _revisited(opened, asked)
    own = _own_maps(opened, asked)
    order = DatasetOrder(
        build=manifest.build,
        objects=None if scenes_from or revisits else objects,
        out=str(root),
        scenes=None if scenes_from or revisits else manifest.num_scenes,
        licence=licence,
        textures=own.get("textures"),
        skies=own.get("skies"),
        map_licence=own.get("map_licence"),
        scenes_from=scenes_from,
        revisits=revisits,
        views=manifest.num_views if scenes_from else None,
        albedo_over_one=cast(AlbedoOverOne, value_of(asked, "--albedo-over-one") or "scale"),
        changes=changes,
    )  # checks everything before a shard is moved
    for name in bad_shards:
        if (root / name).exists():
            (root / name).replace(root / f"{name}{ASIDE}")
    outcome = make_dataset(order, ThreadRunner())
    if outcome.digest != manifest.dataset_digest:
        raise TrilightError(
            f"{root}: the shards were made again, but the dataset digest is {outcome.digest}; "
            f"expected {manifest.dataset_digest}. The bad ones are kept as *.tar{ASIDE}."
        )
    for name in bad_shards:
        (root / f"{name}{ASIDE}").unlink(missing_ok=True)


def _require_generated(manifest: Manifest, scenes_from: str | None) -> None:
    """Refuse what `generate` cannot make again with what was given."""
    if (derivation := derivation_of(manifest.settings)) is not None:
        raise TrilightError(
            f"the dataset was made by `trilight shards {derivation.operation}`; expected one of "
            "`trilight generate`. Make it again from its sources: the bytes will be the same."
        )
    of_files = _is_of_files(manifest)
    if of_files and scenes_from is None:
        raise TrilightError(
            f"build {manifest.build!r} was made from scene files; expected --scenes-from FOLDER, "
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


def _revisited(dataset: Dataset, asked: Sequence[str]) -> str | None:
    """Return the folder of the dataset whose scenes these are, as `logs/asked.json` has it."""
    settings = dataset.manifest.settings
    if "revisit" not in settings:
        return None
    if (place := value_of(asked, "--revisits")) is None:
        raise TrilightError(
            f"{dataset.shown}: its scenes are those of the dataset "
            f"{settings['revisit']['source_digest']}, and logs/asked.json does not say where that "
            "is. Delete the bad shards, and run the same `trilight revisit` again."
        )
    return place


def _own_maps(dataset: Dataset, asked: Sequence[str]) -> dict[str, str | None]:
    """Return the folders of textures and maps, as `logs/asked.json` has them.

    Raises:
        TrilightError: the dataset has such, and it does not say where they are.
    """
    kinds = {entry.kind for entry in dataset.objects_lock()}
    options = {TEXTURE: "textures", SKY: "skies"}
    given: dict[str, str | None] = {
        name: value_of(asked, f"--{name}") for kind, name in options.items() if kind in kinds
    }
    if None in given.values():
        raise TrilightError(
            f"{dataset.shown}: its scenes have textures or maps of a folder, and logs/asked.json "
            "does not say where that is. Delete the bad shards, and run the same `trilight "
            "generate` again."
        )
    return given | ({"map_licence": value_of(asked, "--map-licence")} if given else {})


def _changes(manifest: Manifest) -> dict[str, object]:
    """Return in what the settings of a dataset differ from those of its build's name."""
    build = named_build(manifest.build).as_json()
    changed = {name: now for name, _, now in differences(build, manifest.settings)}
    if _is_of_files(manifest):
        return {name: now for name, now in changed.items() if name not in _OF_SCENE_FILES}
    return changed


def _stated_licence(dataset: Dataset) -> str | None:
    """Return what `--licence` said when the objects were frozen; it holds for all of them."""
    locked = dataset.objects_lock()
    return next(
        (
            entry.licence
            for entry in locked
            if entry.licence_source == BY_USER and entry.kind == OBJECT
        ),
        None,
    )
