"""Upload of a folder to the Hugging Face hub, by the package huggingface_hub.

The hub's limits are from https://huggingface.co/docs/hub/storage-limits, "Repository limitations"
(2026-11).
"""

import re
from collections import Counter
from pathlib import Path
from typing import Literal

from pipeline.documents.checksums import SUMS, UNPUBLISHED, published_files, stale_sums
from storage.dataset.layout import DatasetFolder
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError

RepositoryKind = Literal["dataset", "model", "space"]

NETWORK_FILE = "model.safetensors"

_PART = r"(?!\S*(?:--|\.\.))\w(?:[\w.-]{0,94}\w)?"
_REPOSITORY = re.compile(f"{_PART}/{_PART}", re.ASCII)
"""Names that huggingface_hub accepts; it would refuse others only later."""

MOST_FILES = 100_000
"""Maximum number of files of a repository."""

MOST_ENTRIES = 10_000
"""Maximum number of entries of a folder."""

MOST_FILE_BYTES = 20_000_000_000
"""Maximum size of a file."""


def kind_of(folder: Path) -> RepositoryKind:
    """Return the kind of repository that a folder makes; raises TrilightError if it makes none."""
    if DatasetFolder(folder).manifest.is_file():
        return "dataset"
    if (folder / NETWORK_FILE).is_file():
        return "model"
    if (folder / "index.html").is_file():
        return "space"
    raise TrilightError(
        f"{folder}: expected a folder of this machine with a dataset (manifest.json), a network "
        f"({NETWORK_FILE}) or a page (index.html); make one with trilight generate, trilight train "
        "or make release."
    )


def planned_upload(folder: Path, repository: str) -> tuple[RepositoryKind, int, int]:
    """Return kind, files and bytes of the upload of a folder, after checking the folder.

    Args:
        repository: its name as USER/NAME.

    Raises:
        TrilightError: the repository's name is invalid, or the folder is no release: an unfinished
            or damaged dataset, a missing card, wrong checksums, or more than the hub's limits.
    """
    if not _REPOSITORY.fullmatch(repository) or repository.endswith(".git"):
        raise TrilightError(
            f"repository is {repository}; expected USER/NAME of letters, digits and single -, _ "
            "and . between them, as the hub takes them."
        )
    kind = kind_of(folder)
    if kind == "dataset":
        verification = verify_dataset(str(folder), fast=True)
        if not verification.is_finished:
            raise TrilightError(
                f"{folder}: is not finished; expected a whole dataset. Run its trilight generate "
                "again."
            )
        if verification.problems:
            raise TrilightError(
                f"{folder}: is damaged ({verification.problems[0].rstrip('.')}); expected a whole "
                f"dataset. See trilight verify {folder}."
            )
    if not (folder / "README.md").is_file():
        raise TrilightError(
            f"{folder}: has no README.md, the card that the hub shows; a dataset's is written by "
            "trilight inspect, those of a release by make release, that of your own network by "
            "you: what it is, what it learnt from, and its license."
        )
    if stale := stale_sums(folder):
        raise TrilightError(
            f"{folder / SUMS}: {stale[0]} is not as it says; expected sums of what is uploaded. "
            f"Delete {SUMS}, or write it again with make release."
        )
    return kind, *require_within_limits(folder)


def push(folder: Path, repository: str, kind: RepositoryKind, *, private: bool) -> str:
    """Upload the published files that a repository lacks, and return its URL.

    The token is that of HF_TOKEN or of `hf auth login`; the hub is HF_ENDPOINT or the usual one.

    Raises:
        TrilightError: the package is missing, the hub refuses, or a repository that should be
            private is public.
    """
    try:
        from huggingface_hub import HfApi
        from huggingface_hub.errors import HfHubHTTPError, LocalTokenNotFoundError
    except ImportError as error:
        raise TrilightError("push: needs huggingface_hub; pip install huggingface_hub.") from error
    hub = HfApi()
    try:
        made = hub.create_repo(
            repository,
            repo_type=kind,
            private=private,
            exist_ok=True,
            space_sdk="static" if kind == "space" else None,
        )
        # an existing repository is never changed
        if private and not hub.repo_info(repository, repo_type=kind).private:
            raise TrilightError(
                f"{repository}: is there already and public; expected a private one. Make "
                "it private in its settings on the hub, or leave out --private."
            )
        hub.upload_folder(
            repo_id=repository,
            repo_type=kind,
            folder_path=folder,
            ignore_patterns=list(UNPUBLISHED),
            commit_message=f"Upload of {len(published_files(folder))} files",
        )
    except TrilightError:
        raise
    except Exception as error:  # also of whichever HTTP library the package uses
        is_refusal = isinstance(error, HfHubHTTPError)
        status = getattr(getattr(error, "response", None), "status_code", 0)
        if isinstance(error, LocalTokenNotFoundError) or (is_refusal and status in (401, 403)):
            raise TrilightError(
                f"{repository}: the hub takes uploads from its owner alone; set HF_TOKEN to a "
                "token that may write there, or run hf auth login."
            ) from error
        what = "the hub refused" if is_refusal else "the upload broke off"
        said = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
        raise TrilightError(
            f"{repository}: {what} ({said}). What it has already is kept: run it again."
        ) from error
    return str(made.url)


def require_within_limits(folder: Path) -> tuple[int, int]:
    """Return the numbers of files and bytes of a folder's upload.

    Raises:
        TrilightError: the folder is empty, or exceeds the hub's limits.
    """
    files = published_files(folder).values()
    sizes = {path: path.stat().st_size for path in files}
    entries = Counter(path.parent for path in files).most_common(1)
    largest = max(sizes, key=lambda path: sizes[path], default=None)
    for got, limit, what in (
        (len(files), MOST_FILES, "files"),
        (entries[0][1] if entries else 0, MOST_ENTRIES, "entries in one folder"),
        (sizes[largest] if largest else 0, MOST_FILE_BYTES, f"bytes in one file, {largest}"),
    ):
        if got > limit:
            raise TrilightError(
                f"{folder}: {got} {what}; the hub advises at most {limit}. Make larger or smaller "
                "shards: trilight shards reshard."
            )
    if not files:
        raise TrilightError(f"{folder}: holds no file; expected a finished dataset or a network.")
    return len(files), sum(sizes.values())
