"""What a user says of a run besides the experiment and the effort."""

from pathlib import Path

from pipeline.objects.licences import DEFAULT_ALLOWED
from storage.settings.described import checked


@checked()
class Asked:
    """What it is measured on."""

    objects: tuple[str, ...] = ("builtin:",)
    """Sources of objects."""
    allow_licences: tuple[str, ...] = ()
    """Licences of objects that are measured too; by default the usual ones are."""
    scenes: Path | None = None
    """Folder of RenderFormer scenes that are rendered as well; by default none."""
    checkpoint: str = "builtin:"
    """Network that is measured; by default the one that comes with Trilight."""
    data: str | None = None
    """Root of a finished dataset, for the experiment economy; by default none."""

    @property
    def allowed_licences(self) -> tuple[str, ...]:
        """Licences of objects that may be measured."""
        return (*DEFAULT_ALLOWED, *self.allow_licences)
