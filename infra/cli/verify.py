"""`trilight verify`: checks a dataset against its manifest."""

import sys

from infra.cli.console import (
    first_words,
    next_step,
    print_json,
    print_rows,
    progress_bars,
    suggest_look,
)
from infra.cli.options import command
from storage.dataset.dataset import open_dataset
from storage.dataset.derived import derivation_of
from storage.dataset.planned import num_planned
from storage.dataset.progress import read_asked, value_of
from storage.dataset.verify import Verification, verify_dataset
from storage.remote.safe_url import safe_url
from storage.remote.url import RemoteUrl, parse_url
from storage.settings.described import checked


@checked()
class VerifyOptions:
    """Dataset and checks."""

    dataset: str
    """Dataset, a folder or a URL."""
    fast: bool = False
    """Check sizes and counts only."""
    repair: bool = False
    """Make missing and bad shards again, and check again."""
    objects: str | None = None
    """Source of objects for --repair; by default that of the generate command."""
    scenes_from: str | None = None
    """Folder of the dataset's scene files, for --repair; by default none."""


@command("dataset")
def verify(options: VerifyOptions) -> None:
    first_words(f"Verifying {safe_url(options.dataset)}")
    verification = _verify(options.dataset, fast=options.fast)
    if options.repair and verification.bad_shards and verification.is_finished:
        from infra.repair import repair as make_anew  # slow: the whole pipeline

        _report(verification, fast=options.fast)
        first_words("Repairing the named shards")
        make_anew(
            options.dataset,
            verification.bad_shards,
            objects=options.objects,
            scenes_from=options.scenes_from,
        )
        verification = _verify(options.dataset, fast=options.fast)
    print_json(_as_json(verification))
    _report(verification, fast=options.fast)
    _print_repair(verification, options.dataset)
    if verification.problems or not verification.is_finished:
        sys.exit(1)


def _verify(dataset: str, *, fast: bool) -> Verification:
    opened = open_dataset(dataset)
    with progress_bars() as bars:
        total = len(opened.manifest.shards) or None
        task = bars.add_task("shards", total=total, note="")
        return verify_dataset(opened, fast=fast, shard_done=lambda _: bars.advance(task))


def _print_repair(verification: Verification, dataset: str) -> None:
    """Print how to complete or repair a dataset, depending on how it was made."""
    generate_command = read_asked(open_dataset(dataset))
    is_remote = isinstance(parse_url(dataset, what="dataset"), RemoteUrl)
    derivation = derivation_of(verification.manifest.settings)
    if not verification.is_finished:
        if generate_command is not None:
            next_step(
                (*generate_command, "--out", dataset), recorded=verification.manifest.extensions
            )
        else:
            suggest_look("To resume, run the trilight generate command that began it.")
    elif not verification.problems:
        return
    elif not verification.bad_shards:
        suggest_look(
            "No shard was found wrong. Verify again what could not be read. A document that was "
            "edited is written anew by the command that made the dataset (keep notes in a file of "
            "your own). Restore other named files from a copy."
        )
    elif is_remote:
        suggest_look(
            "Delete the named shards there and run trilight generate again, or copy them again "
            "from the folder that the dataset was copied from."
        )
    elif derivation is not None:
        suggest_look(f"Make it again from its sources: trilight shards {derivation.operation}.")
    else:
        sources = ("--objects", "--scenes-from")
        values = [(option, value_of(generate_command or (), option)) for option in sources]
        named = [word for option, value in values if value for word in (option, value)]
        words = ("verify", dataset, "--repair", *named)
        next_step(words, recorded=verification.manifest.extensions)


def _as_json(verification: Verification) -> dict[str, object]:
    return {
        "bad_shards": list(verification.bad_shards),
        "dataset_digest": verification.manifest.dataset_digest,
        "finished": verification.is_finished,
        "problems": list(verification.problems),
        "samples": verification.manifest.num_samples,
        "scenes_planned": verification.manifest.num_scenes,
        "shards": len(verification.manifest.shards),
        "shards_planned": num_planned(verification.manifest),
    }


def _report(verification: Verification, *, fast: bool) -> None:
    manifest = verification.manifest
    shards = f"{len(manifest.shards)}"
    title = "Verified"
    if not verification.is_finished:
        shards += f" of {num_planned(verification.manifest)}"
        title = "Unfinished; everything present is valid"
    rows = [
        ("dataset digest", manifest.dataset_digest),
        ("shards", f"{shards}, {manifest.num_bytes / 1e6:.1f} MB"),
        ("scenes", f"{verification.manifest.num_samples} of {manifest.num_scenes} planned"),
        ("checked", "sizes and counts" if fast else "hashes, members, laws, pictures, splits"),
        *(("wrong", problem) for problem in verification.problems),
    ]
    print_rows("Does not match its manifest" if verification.problems else title, rows)
