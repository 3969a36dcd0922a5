"""What a user says of a run besides the experiment and the effort."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.objects.licences import DEFAULT_ALLOWED


@dataclass(frozen=True, kw_only=True)
class Asked:
    """Inputs of an experiment; each has a default that needs nothing."""

    objects: tuple[str, ...] = ("builtin:",)
    """Sources of objects."""
    allowed_licences: tuple[str, ...] = DEFAULT_ALLOWED
    """Licences of objects that may be measured."""
    scenes: Path | None = None
    """Folder of RenderFormer scene files that belong to the named set as well."""
    checkpoint: str = "builtin:"
    """Network that is compared with the path tracer."""
    data: str = ""
    """Root of a finished dataset, for experiments that need one."""
