"""`trilight verify`: is a dataset what its manifest says?"""

import sys

from infra.cli.console import (
    first_words,
    look_at,
    next_step,
    print_json,
    print_rows,
    progress_bars,
)
from infra.cli.options import Shown, command
from storage.dataset.asked import read_asked, value_of
from storage.dataset.dataset import open_dataset
from storage.dataset.derived import derivation_of
from storage.dataset.verify import Verification, verify_dataset
from storage.remote.safe_url import safe_url
from storage.remote.url import RemoteUrl, parse_url
from storage.settings.described import checked


@checked()
class Checked:
    """The dataset, and what to check."""

    dataset: str
    """The dataset, a folder or a URL."""
    fast: bool = False
    """Check sizes and counts only."""
    repair: bool = False
    """Make missing and bad shards anew, and check again."""
    objects: str | None = None
    """With --repair: source of objects; by default that of the generate command."""
    scenes_from: str | None = None
    """With --repair: folder of the scene files that the dataset was made of; by default none."""


@command("dataset")
def verify(asked: Checked, shown: Shown) -> None:
    first_words(f"Verifying {safe_url(asked.dataset)}", silent=shown.json)
    found = _verified(asked.dataset, fast=asked.fast, silent=shown.json)
    if asked.repair and found.bad_shards and found.is_finished:
        from infra.repair import repair as make_anew  # slow: the whole pipeline

        if not shown.json:
            _report(found, fast=asked.fast)
            first_words("Repairing the named shards")
        make_anew(
            asked.dataset, found.bad_shards, objects=asked.objects, scenes_from=asked.scenes_from
        )
        found = _verified(asked.dataset, fast=asked.fast, silent=shown.json)
    if shown.json:
        print_json(_as_json(found))
    else:
        _report(found, fast=asked.fast)
        _print_repair(found, asked.dataset)
    if found.problems or not found.is_finished:
        sys.exit(1)


def _verified(dataset: str, *, fast: bool, silent: bool) -> Verification:
    opened = open_dataset(dataset)
    with progress_bars() as bars:
        total = len(opened.manifest.shards) or None
        task = bars.add_task("shards", total=total, note="", visible=not silent)
        return verify_dataset(opened, fast=fast, shard_done=lambda _: bars.advance(task))


def _print_repair(found: Verification, dataset: str) -> None:
    """Print how to complete or repair a dataset, which depends on how it was made."""
    asked = read_asked(open_dataset(dataset))
    is_remote = isinstance(parse_url(dataset, what="dataset"), RemoteUrl)
    derivation = derivation_of(found.manifest.settings)
    if not found.is_finished:
        if asked is not None:
            next_step((*asked, "--out", dataset), recorded=found.manifest.extensions)
        else:
            look_at("To resume, run the trilight generate command that began it.")
    elif not found.problems:
        return
    elif not found.bad_shards:
        look_at(
            "No shard was found wrong. Verify again what could not be read, and restore other "
            "named files from a copy."
        )
    elif is_remote:
        look_at(
            "Delete the named shards there and run trilight generate again, or copy them again "
            "from the folder that the dataset was copied from."
        )
    elif derivation is not None:
        look_at(f"Make it again from its sources: trilight shards {derivation.operation}.")
    else:
        sources = ("--objects", "--scenes-from")
        given = [(option, value_of(asked or (), option)) for option in sources]
        named = [word for option, value in given if value for word in (option, value)]
        words = ("verify", dataset, "--repair", *named)
        next_step(words, recorded=found.manifest.extensions)


def _as_json(found: Verification) -> dict[str, object]:
    return {
        "bad_shards": list(found.bad_shards),
        "dataset_digest": found.manifest.dataset_digest,
        "finished": found.is_finished,
        "problems": list(found.problems),
        "samples": found.num_samples,
        "scenes_planned": found.manifest.num_scenes,
        "shards": len(found.manifest.shards),
        "shards_planned": found.num_shards_planned,
    }


def _report(found: Verification, *, fast: bool) -> None:
    manifest = found.manifest
    rows = [
        ("dataset digest", manifest.dataset_digest),
        ("shards", f"{_shards(found)}, {manifest.num_bytes / 1e6:.1f} MB"),
        ("scenes", f"{found.num_samples} of {manifest.num_scenes} planned"),
        ("checked", "sizes and counts" if fast else "hashes, members, laws, pictures, splits"),
        *(("wrong", problem) for problem in found.problems),
    ]
    print_rows(_verdict(found), rows)


def _shards(found: Verification) -> str:
    there = len(found.manifest.shards)
    return f"{there}" if found.is_finished else f"{there} of {found.num_shards_planned}"


def _verdict(found: Verification) -> str:
    if found.problems:
        return "Does not match its manifest"
    return "Verified" if found.is_finished else "Unfinished; everything present is valid"
