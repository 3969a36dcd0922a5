"""Options of `trilight leaderboard`; this module imports no torch."""

from pathlib import Path
from typing import Annotated, Literal

from storage.settings.described import checked
from storage.settings.ranges import Within
from train.evaluation.options import SceneCount, Width

TimedScenes = Annotated[int, Within(1, 10**6, unit="scenes")]
"""Maximum number of scenes on which everything is timed."""


@checked()
class LeaderboardOptions:
    """Dataset, networks and pictures."""

    source: str
    """Dataset (folder or URL) with pictures, such as one of preset benchmark-v1."""
    checkpoint: tuple[str, ...] = ()
    """Networks in addition to the built-in ones; by default none. A network is a run, weights, or a
    name on the Hugging Face hub such as microsoft/renderformer-v1-base. All other rows are compared
    with the first one."""
    pictures: tuple[Path, ...] = ()
    """Folders of OpenEXR pictures from elsewhere, named as export names them; by default none. Each
    has one picture a view, such as 000000003_view_0.exr."""
    width: tuple[Width, ...] = ()
    """Widths of pictures in pixels, divisors of the dataset's; by default those of 64, 256 and 512
    that divide it, else the dataset's own."""
    scenes: SceneCount = 10**6
    """Maximum number of scenes, from the start of the split."""
    timed_scenes: TimedScenes = 20
    """Maximum number of scenes on which CPU seconds are measured."""
    split: Literal["train", "validation", "test"] = "test"
    """Split of the dataset for the evaluation."""
    train_data: tuple[str, ...] = ()
    """Datasets whose training pictures are looked up; by default the set itself, else the other
    scenes of the split."""
    lpips: str | None = None
    """Folder of the LPIPS weights, or hub; by default the value of TRILIGHT_LPIPS. Without weights
    LPIPS is n/a."""
    out: Path = Path("leaderboard")
    """Folder for table, chart and rows; with existing rows a run resumes."""
