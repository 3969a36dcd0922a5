"""Begins a dataset in a folder, or resumes the one there if its settings are the same."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pipeline.builds.settings import BuildSettings, differences
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.renders.variant import device_of
from storage.dataset.derived import derivation_of
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, read_head, write_manifest
from storage.dataset.splits import planned_scenes
from storage.errors import TrilightError
from storage.extensions import extension_digests, require_same_extensions
from storage.settings.described import from_record


def begin(
    folder: DatasetFolder,
    settings: BuildSettings,
    environment: Mapping[str, Any],
    num_scenes: int,
    *,
    accept_environment: bool,
) -> DatasetWriter:
    """Begin a dataset in a folder, or resume the one that is there.

    The number of scenes never falls.

    Raises:
        TrilightError: the dataset was begun with other settings, or in another environment and
            `accept_environment` is False; the message names what differs.
    """
    if num_scenes < 1:
        raise TrilightError(f"scenes is {num_scenes}; expected at least 1.")
    num_planned = planned_scenes(num_scenes, settings.splits)
    with folder.mutex("manifest"):
        if folder.manifest.exists():
            manifest = read_head(folder.manifest)
            _require_same_dataset(folder, manifest, settings, environment, accept_environment)
            num_planned = max(num_planned, manifest.num_scenes)
        else:
            require_free(folder, _names_in(folder))
            manifest = Manifest(
                build=settings.build,
                settings=settings.as_json(),
                environment=environment,
                num_scenes=num_planned,
                num_views=settings.scenes.num_views,
                objects_lock_sha256="",
                shards=(),
                extensions=extension_digests("data"),
            )
            write_manifest(folder.manifest, manifest)
        writer = DatasetWriter(folder, manifest, settings.splits)
        if num_planned != manifest.num_scenes:
            writer.extend(num_planned)
    return writer


def _require_same_dataset(
    folder: DatasetFolder,
    manifest: Manifest,
    settings: BuildSettings,
    environment: Mapping[str, Any],
    accept_environment: bool,
) -> None:
    _require_generated(folder, manifest)
    require_same_extensions(folder.display_name, manifest.extensions, extension_digests("data"))
    stored = from_record(BuildSettings, manifest.settings).as_json()  # fields may come later
    _require_same(folder, "setting", stored, settings.as_json(), "choose another --out")
    if not accept_environment:
        before = device_of(manifest.environment)
        now = device_of(environment)
        if before != now:
            raise TrilightError(
                f"{folder.display_name}: this dataset was begun on a {before.upper()} and would "
                f"go on with a {now.upper()}; choose --device {before} or another --out, or accept "
                "pictures that agree only within their noise floors with --accept-environment."
            )
        _require_same(
            folder,
            "environment",
            manifest.environment,
            environment,
            "choose another --out, or accept pictures that agree only within their noise "
            "floors with --accept-environment",
        )


def require_free(folder: DatasetFolder, names: Iterable[str]) -> None:
    """Raise if a folder or bucket holds files that a new dataset would replace.

    Args:
        folder: the dataset's folder.
        names: names of the shards and documents that exist there.

    Raises:
        TrilightError: there are shards, or a document that the dataset's own would replace.
    """
    existing = set(names)
    if any(name.endswith(".tar") for name in existing):
        raise TrilightError(
            f"{folder.display_name}: there are shards but no manifest.json; expected an empty "
            "folder or a "
            "dataset. Choose another --out."
        )
    for path in (folder.card, folder.licences):
        if path.name in existing:
            raise TrilightError(
                f"{folder.display_name}: {path.name} is there, and the dataset's own would replace "
                "it; "
                "expected an empty folder or a dataset. Choose another --out."
            )


def _names_in(folder: DatasetFolder) -> Iterator[str]:
    yield from (path.relative_to(folder.root).as_posix() for path in folder.shard_files())
    yield from (path.name for path in (folder.card, folder.licences) if path.exists())


def _require_generated(folder: DatasetFolder, manifest: Manifest) -> None:
    if derivation := derivation_of(manifest.settings):
        raise TrilightError(
            f"{folder.display_name}: this dataset was made by `trilight shards "
            f"{derivation.operation}` "
            "and cannot grow; extend its sources and make it again, or choose another --out."
        )


def _require_same(
    folder: DatasetFolder,
    what: str,
    before: Mapping[str, Any],
    now: Mapping[str, Any],
    next_step: str,
) -> None:
    differing = list(differences(before, now))
    if differing:
        name, old, new = differing[0]
        more = f" (and {len(differing) - 1} more)" if len(differing) > 1 else ""
        raise TrilightError(
            f"{folder.display_name}: this dataset was begun with another {what}: {name} was "
            f"{old!r}, now "
            f"{new!r}{more}; {next_step}."
        )
