"""Uploads a folder to a repository of the Hugging Face hub, by its own package."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from infra.release.hub_limits import require_within_limits
from pipeline.documents.sums import SUMS, UNPUBLISHED, stale_sums
from storage.dataset.layout import DatasetFolder
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError

if TYPE_CHECKING:
    from huggingface_hub import HfApi

RepositoryKind = Literal["dataset", "model", "space"]

NETWORK_FILE = "model.safetensors"

_PART = r"(?!\S*(?:--|\.\.))\w(?:[\w.-]{0,94}\w)?"
_REPOSITORY = re.compile(f"{_PART}/{_PART}", re.ASCII)
"""As huggingface_hub refuses others, only later."""


@dataclass(frozen=True, kw_only=True)
class Upload:
    """What goes where."""

    folder: Path
    """All of it is uploaded, but for what is ignored."""
    repository: str
    """USER/NAME."""
    kind: RepositoryKind
    """Of the repository."""
    files: int
    """Number of files."""
    num_bytes: int
    """Of all files together."""


def kind_of(folder: Path) -> RepositoryKind:
    """Return what kind of repository a folder makes; raises TrilightError where it is none."""
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


def planned_upload(folder: Path, repository: str) -> Upload:
    """Return what would be uploaded, after looking whether it should be.

    Raises:
        TrilightError: the name is none, the folder is no release, an unfinished or damaged dataset,
            a network without its card, sums of other files, or more than the hub advises.
    """
    if not _REPOSITORY.fullmatch(repository) or repository.endswith(".git"):
        raise TrilightError(
            f"repository is {repository}; expected USER/NAME of letters, digits and single -, _ "
            "and . between them, as the hub takes them."
        )
    kind = kind_of(folder)
    if kind == "dataset":
        _require_sound(folder)
    if not (folder / "README.md").is_file():
        raise TrilightError(
            f"{folder}: has no README.md, the card that the hub shows; a dataset's is written by "
            "trilight inspect, those of a release by make release, that of your own network by "
            "you: what it is, what it learnt from, and its licence."
        )
    if stale := stale_sums(folder):
        raise TrilightError(
            f"{folder / SUMS}: {stale[0]} is not as it says; expected sums of what is uploaded. "
            f"Delete {SUMS}, or write it again with make release."
        )
    files, num_bytes = require_within_limits(folder)
    return Upload(folder=folder, repository=repository, kind=kind, files=files, num_bytes=num_bytes)


def push(upload: Upload, *, private: bool) -> str:
    """Upload a folder, as far as the repository does not have it, and return its address.

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
            upload.repository,
            repo_type=upload.kind,
            private=private,
            exist_ok=True,
            space_sdk="static" if upload.kind == "space" else None,
        )
        if private:
            _require_private(hub, upload)
        hub.upload_folder(
            repo_id=upload.repository,
            repo_type=upload.kind,
            folder_path=upload.folder,
            ignore_patterns=list(UNPUBLISHED),
            commit_message=f"Upload of {upload.files} files",
        )
    except TrilightError:
        raise
    except LocalTokenNotFoundError as error:
        raise TrilightError(_NO_TOKEN.format(repository=upload.repository)) from error
    except HfHubHTTPError as error:
        if error.response is not None and error.response.status_code in (401, 403):
            raise TrilightError(_NO_TOKEN.format(repository=upload.repository)) from error
        raise _broken_off(upload, "the hub refused", error) from error
    except Exception as error:  # of whichever library the package speaks HTTP with
        raise _broken_off(upload, "the upload broke off", error) from error
    return str(made.url)


def _require_private(hub: "HfApi", upload: Upload) -> None:
    """Refuse to show the world what should be private: who made a repository, chose that."""
    if not hub.repo_info(upload.repository, repo_type=upload.kind).private:
        raise TrilightError(
            f"{upload.repository}: is there already and public; expected a private one. Make it "
            "private in its settings on the hub, or leave out --private."
        )


_NO_TOKEN = (
    "{repository}: the hub takes uploads from its owner alone; set HF_TOKEN to a token that may "
    "write there, or run hf auth login."
)


def _broken_off(upload: Upload, what: str, error: Exception) -> TrilightError:
    said = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
    return TrilightError(
        f"{upload.repository}: {what} ({said}). What it has already is kept: run it again."
    )


def _require_sound(folder: Path) -> None:
    verification = verify_dataset(str(folder), fast=True)
    if not verification.is_finished:
        raise TrilightError(
            f"{folder}: is not finished; expected a whole dataset. Run its trilight generate again."
        )
    if verification.problems:
        raise TrilightError(
            f"{folder}: is damaged ({verification.problems[0].rstrip('.')}); expected a whole "
            f"dataset. See trilight verify {folder}."
        )
