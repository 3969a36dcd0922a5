"""`trilight push`: a folder to a repository of the Hugging Face hub."""

from pathlib import Path

from infra.cli.console import first_words, look_at, next_step, print_json, print_rows
from infra.cli.options import Shown, command
from storage.settings.described import checked


@checked()
class PushAsked:
    """What to upload, and where to."""

    folder: Path
    """Finished dataset, folder with model.safetensors, or page with index.html."""
    repository: str
    """Repository USER/NAME; made where it is missing."""
    private: bool = False
    """Make a new repository private; refuse one that is public."""
    dry_run: bool = False
    """Only check and say what would be uploaded."""


@command("folder", "repository")
def push(asked: PushAsked, shown: Shown) -> None:
    first_words(f"Looking through {asked.folder}", silent=shown.json)
    from infra.release.push import planned_upload
    from infra.release.push import push as upload_all

    upload = planned_upload(asked.folder, asked.repository)
    facts: dict[str, str | int] = {
        "folder": str(upload.folder),
        "repository": upload.repository,
        "kind": upload.kind,
        "files": upload.files,
        "bytes": upload.num_bytes,
    }
    if not asked.dry_run:
        first_words(f"Uploading to {upload.repository}", silent=shown.json)
        facts["address"] = upload_all(upload, private=asked.private)
    if shown.json:
        print_json(facts)
        return
    rows = [(name, str(value)) for name, value in facts.items() if name != "bytes"]
    title = "Would be uploaded" if asked.dry_run else "Uploaded"
    print_rows(title, [*rows, ("size", f"{upload.num_bytes / 1e6:.1f} MB")])
    if asked.dry_run:
        private = ["--private"] if asked.private else []
        next_step(["push", str(asked.folder), asked.repository, *private])
    elif upload.kind == "dataset":
        next_step(["verify", f"hf://datasets/{upload.repository}"])
    else:
        look_at(f"Look at {facts['address']}")
