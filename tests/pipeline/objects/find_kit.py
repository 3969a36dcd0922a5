"""Short names for finding objects in tests."""

from pathlib import Path
from typing import Any

from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.sources import FoundObjects, find_objects


def find(url: str, **options: Any) -> FoundObjects:
    options = {"allowed_licences": DEFAULT_ALLOWED, **options}
    return find_objects(url, work_dir=Path("unused"), **options)


def reasons(found: FoundObjects) -> dict[str, str]:
    return {failure.item: failure.reason for failure in found.failures}
