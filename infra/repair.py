"""Making anew exactly the shards of a local dataset that are missing or bad."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.flows.builds import named_build
from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from pipeline.flows.settings import differences
from storage.dataset import open_dataset
from storage.errors import TrilightError
from storage.manifest import Manifest
from storage.remote.url import parse_url

ASIDE = ".bad"
"""Ends the name of a bad shard until its successor is there."""


def repair(dataset: str, bad_shards: Sequence[str], *, objects: str | None) -> None:
    """Set bad shards aside and have `generate` make them, from the settings of the manifest.

    Shards that are whole stay as they are, to the byte. The bad files are deleted at the end; where
    the making fails, they lie beside the dataset with the ending `.bad`.

    Args:
        dataset: folder of the dataset.
        bad_shards: their names (storage.verify).
        objects: where the objects come from, as it was said to `generate`.

    Raises:
        TrilightError: the dataset is on a server, was made from scene files, or was begun in
            another environment; or what was made has other bytes than the manifest says.
    """
    root = parse_url(dataset, what="dataset")
    if not isinstance(root, Path):
        raise TrilightError(
            f"dataset {root.shown!r} is on a server; expected a folder to repair. Repair the "
            "folder that it was copied from."
        )
    manifest = open_dataset(str(root)).manifest
    changes = _changes(manifest)
    quiet_prefect()
    for name in bad_shards:
        if (root / name).exists():
            (root / name).replace(root / f"{name}{ASIDE}")
    with prefect_server():
        from pipeline.flows.generate_scenes import generate_scenes  # after Prefect is quiet

        outcome = generate_scenes(
            build=manifest.build,
            objects=objects,
            out=str(root),
            scenes=manifest.num_scenes,
            changes=changes,
        )
    if outcome.digest != manifest.dataset_digest:
        raise TrilightError(
            f"{root}: the shards were made again, but the dataset digest is {outcome.digest}; "
            f"expected {manifest.dataset_digest}. The bad ones are kept as *.tar{ASIDE}."
        )
    for name in bad_shards:
        (root / f"{name}{ASIDE}").unlink(missing_ok=True)


def _changes(manifest: Manifest) -> dict[str, object]:
    """Return in what the settings of a dataset differ from those of its build's name."""
    if manifest.settings["splits"].get("listed_scenes") is not None:
        raise TrilightError(
            f"build {manifest.build!r} was made from scene files; expected one that draws its "
            "scenes. Delete the bad shards and run `trilight generate --scenes-from` again."
        )
    build = named_build(manifest.build).as_json()
    return {name: now for name, _, now in differences(build, manifest.settings)}
