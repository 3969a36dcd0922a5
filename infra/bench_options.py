"""The inputs of `trilight bench`, also where the experiments are missing."""

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
    """Licences of objects to allow besides the usual ones; by default there are none."""
    scenes: Path | None = None
    """Folder of RenderFormer or glTF scenes that frontier and cycles render as well; by default
    none."""
    checkpoint: tuple[str, ...] = ("builtin:",)
    """Networks for methods; every other row is compared with the first one."""
    data: str | None = None
    """Finished dataset (a folder or a URL) for paired-training, and for loader and gpu in place of
    scenes that they render; by default none."""
    run: tuple[str, ...] = ()
    """Training presets: the one of paired-training (by default smoke), or those whose steps gpu
    takes (by default all of ours)."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the training preset on both sides of paired-training, by dotted name; by default
    there are none."""
    set_a: Mapping[str, Any] = field(default_factory=dict)
    """Changes on the side that is compared with, such as optimiser settings; by default none."""
    set_b: Mapping[str, Any] = field(default_factory=dict)
    """Changes on the side that is tried; by default none."""
    seeds: Annotated[int, Within(1, 1000, unit="seeds")] = 2
    """Number of seeds of paired-training: each trains both sides once."""
    device: Literal["cpu", "cuda"] | None = None
    """Device of paired-training and gpu; by default the GPU where torch finds one."""

    @property
    def allowed_licences(self) -> tuple[str, ...]:
        """Licences of objects that may be measured."""
        return (*DEFAULT_ALLOWED, *self.allow_licences)
