"""`EvaluationOrder`: everything a user asks of an evaluation. Importing it loads no torch."""

from pathlib import Path
from typing import Annotated, Literal

from storage.settings.described import checked
from storage.settings.ranges import Within

Width = Annotated[int, Within(1, 8192, unit="pixels")]
"""Pixels across a picture."""
SceneCount = Annotated[int, Within(1, 10**9, unit="scenes")]
"""How many scenes are judged."""


@checked()
class EvaluationOrder:
    """Which network is judged, on what."""

    checkpoint: str
    """Folder of a run, model.safetensors or a checkpoint; builtin: for the network that is shipped.
    """
    data: tuple[str, ...]
    """Root of a dataset, or shards by name or pattern; folders or URLs."""
    split: Literal["train", "validation", "test"] = "test"
    """Which split is judged."""
    train_data: tuple[str, ...] = ()
    """Data whose training pictures the rivals know; by default the same, if it has any."""
    resolution: Width | None = None
    """Pixels across, a divisor of the data's; by default the run's if known, else the data's."""
    most_scenes: SceneCount = 10**6
    """Maximum number of scenes that are judged, from the start of the split."""
    lpips: str | None = None
    """Folder of LPIPS' weights, or hub to download them; by default what TRILIGHT_LPIPS says, and
    without it LPIPS is n/a."""
    device: Literal["cpu", "cuda"] | None = None
    """Device that computes; by default cuda where there is one."""
    out: Path = Path("evaluation")
    """Folder of the report."""
