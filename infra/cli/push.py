"""`trilight push`: uploads a folder to a repository of the Hugging Face hub."""

from pathlib import Path

from infra.cli.console import first_words, next_step, print_json, print_rows, suggest_look
from infra.cli.options import command
from storage.settings.described import checked


@checked()
class PushOptions:
    """Upload."""

    folder: Path
    """Finished dataset, folder with model.safetensors, or page with index.html."""
    repository: str
    """Repository USER/NAME, which is created if it is missing."""
    private: bool = False
    """Make a new repository private; refuse one that is public."""
    dry_run: bool = False
    """Check the folder and print the upload, but upload nothing."""


@command("folder", "repository")
def push(options: PushOptions) -> None:
    first_words(f"Looking through {options.folder}")
    from infra.release.push_to_hub import planned_upload
    from infra.release.push_to_hub import push as upload_all

    upload = planned_upload(options.folder, options.repository)
    facts: dict[str, str | int] = {
        "folder": str(upload.folder),
        "repository": upload.repository,
        "kind": upload.kind,
        "files": upload.files,
        "bytes": upload.num_bytes,
    }
    if not options.dry_run:
        first_words(f"Uploading to {upload.repository}")
        facts["address"] = upload_all(upload, private=options.private)
    print_json(facts)
    rows = [(name, str(value)) for name, value in facts.items() if name != "bytes"]
    title = "Would be uploaded" if options.dry_run else "Uploaded"
    print_rows(title, [*rows, ("size", f"{upload.num_bytes / 1e6:.1f} MB")])
    if options.dry_run:
        private = ["--private"] if options.private else []
        next_step(["push", str(options.folder), options.repository, *private])
    elif upload.kind == "dataset":
        next_step(["verify", f"hf://datasets/{upload.repository}"])
    else:
        suggest_look(f"Look at {facts['address']}")
