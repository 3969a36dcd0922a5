"""`trilight verify`: is a dataset what its manifest says?"""

from typing import Annotated

import typer

from infra.cli.console import console, print_json, print_rows, progress_bars
from storage.dataset import open_dataset
from storage.derived import derivation_of
from storage.remote.url import RemoteUrl, parse_url
from storage.verify import Verification, verify_dataset


def verify(
    dataset: Annotated[str, typer.Argument(help="the dataset, a folder or a URL")],
    fast: Annotated[bool, typer.Option(help="compare sizes and counts only")] = False,
    repair: Annotated[
        bool, typer.Option(help="make the shards that are missing or bad anew, and check again")
    ] = False,
    objects: Annotated[
        str | None, typer.Option(help="with --repair: the source of objects, as for generate")
    ] = None,
    scenes_from: Annotated[
        str | None, typer.Option(help="with --repair: the folder of scenes, as for generate")
    ] = None,
    json: Annotated[bool, typer.Option(help="print the result as JSON")] = False,
) -> None:
    """Check every hash, member and law of a dataset; exit 1 with a list of what is wrong."""
    found = _verified(dataset, fast=fast, silent=json)
    if repair and found.bad_shards:
        from infra.repair import repair as make_anew  # slow: the whole pipeline

        if not json:
            _report(found, fast=fast)
        make_anew(dataset, found.bad_shards, objects=objects, scenes_from=scenes_from)
        found = _verified(dataset, fast=fast, silent=json)
    if json:
        print_json(_as_json(found))
    else:
        _report(found, fast=fast)
        if found.bad_shards:
            console.print(f"\nNext: {_next_step(found, dataset)}", style="bold")
    if found.problems:
        raise typer.Exit(1)


def _verified(dataset: str, *, fast: bool, silent: bool) -> Verification:
    num_shards = len(open_dataset(dataset).manifest.shards)
    with progress_bars() as bars:
        task = bars.add_task("shards", total=num_shards, note="", visible=not silent)
        return verify_dataset(dataset, fast=fast, shard_done=lambda _: bars.advance(task))


def _next_step(found: Verification, dataset: str) -> str:
    """Return what makes bad shards whole, which depends on where the dataset is from."""
    settings = found.manifest.settings
    if isinstance(parse_url(dataset, what="dataset"), RemoteUrl):
        return (
            "delete the named shards there and run trilight generate again, or copy them again "
            "from the folder that the dataset was copied from."
        )
    if (derivation := derivation_of(settings)) is not None:
        return f"make it again of its sources: trilight shards {derivation.operation}."
    if settings.get("splits", {}).get("listed_scenes") is not None:
        return "trilight verify --repair --scenes-from FOLDER makes the named shards anew."
    return "trilight verify --repair makes the named shards anew."


def _as_json(found: Verification) -> dict[str, object]:
    return {
        "bad_shards": list(found.bad_shards),
        "dataset_digest": found.manifest.dataset_digest,
        "problems": list(found.problems),
        "samples": found.num_samples,
        "scenes_planned": found.manifest.num_scenes,
        "shards": len(found.manifest.shards),
    }


def _report(found: Verification, *, fast: bool) -> None:
    manifest = found.manifest
    rows = [
        ("dataset digest", manifest.dataset_digest),
        ("shards", f"{len(manifest.shards)}, {manifest.num_bytes / 1e6:.1f} MB"),
        ("scenes", f"{found.num_samples} of {manifest.num_scenes} planned"),
        ("checked", "sizes and counts" if fast else "hashes, members, laws, pictures, splits"),
        *(("wrong", problem) for problem in found.problems),
    ]
    print_rows("Verified" if not found.problems else "Not what the manifest says", rows)
