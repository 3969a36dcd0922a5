"""Options of `trilight bench`; importable also where the experiments are missing."""

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

from pipeline.objects.licences import DEFAULT_ALLOWED
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class BenchOptions:
    """Inputs of the experiments."""

    objects: str = "builtin:"
    """Source of objects for meshes."""
    allow_licences: tuple[str, ...] = ()
    """Licences of objects to allow in addition to the usual ones; by default none."""
    scenes: Path | None = None
    """Folder of RenderFormer or glTF scenes for frontier and cycles; by default none."""
    checkpoint: tuple[str, ...] = ("builtin:",)
    """Networks for methods; every other row is compared with the first one."""
    data: str | None = None
    """Finished dataset for paired-training, loader and gpu; by default rendered scenes, and none
    for paired-training."""
    run: tuple[str, ...] = ()
    """Training presets of paired-training and gpu; by default smoke, and all built-in ones for
    gpu."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the preset on both sides of paired-training; by default none."""
    set_a: Mapping[str, Any] = field(default_factory=dict)
    """Changes on side a of paired-training, the baseline; by default none."""
    set_b: Mapping[str, Any] = field(default_factory=dict)
    """Changes on side b of paired-training, the candidate; by default none."""
    seeds: Annotated[int, Within(1, 1000, unit="seeds")] = 2
    """Number of seeds of paired-training: each trains both sides once."""
    device: Literal["cpu", "cuda"] | None = None
    """Device of paired-training and gpu; by default the GPU if there is one."""

    @property
    def allowed_licences(self) -> tuple[str, ...]:
        """Licences under which objects are accepted."""
        return (*DEFAULT_ALLOWED, *self.allow_licences)
