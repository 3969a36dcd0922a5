"""Short names for finding objects in tests."""

from pathlib import Path
from typing import Any

from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.listing import Listing
from pipeline.objects.sources import list_objects


def touch(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("v 0 0 0")


def find(source: Path | str, **options: Any) -> Listing:
    options = {"allowed_licences": DEFAULT_ALLOWED, "work_dir": Path("unused"), **options}
    selection = {name: options.pop(name) for name in {*options} & {"downloaded"}}
    return list_objects(str(source), **options).fetch_selected(**selection)


def reasons(found: Listing) -> dict[str, str]:
    return {failure.item: failure.reason for failure in found.failures}
