"""`LeaderboardOrder`: everything a user asks of a leaderboard. Importing it loads no torch."""

from pathlib import Path
from typing import Annotated, Literal

from storage.settings.described import checked
from storage.settings.ranges import Within
from train.evaluation.order import SceneCount, Width

TimedScenes = Annotated[int, Within(1, 10**6, unit="scenes")]
"""Maximum number of scenes on which everything is timed."""


@checked()
class LeaderboardOrder:
    """Which set to judge on, and who is judged beside those who never lack."""

    source: str
    """A dataset (folder or URL) with pictures, such as one of the build benchmark-v1."""
    checkpoint: tuple[str, ...] = ()
    """Networks to judge as well as those that come with Trilight: a run, weights, or a name on the
    Hugging Face hub such as microsoft/renderformer-v1-base. All other rows are compared with the
    first; by default with the network that comes with Trilight."""
    pictures: tuple[Path, ...] = ()
    """Folders of OpenEXR pictures made elsewhere, one for each view, called as export calls them:
    000000003_view_0.exr; by default there are none."""
    width: tuple[Width, ...] = ()
    """Widths of pictures in pixels, which divide the dataset's; by default those of 64, 256 and 512
    that do, else the dataset's own."""
    scenes: SceneCount = 10**6
    """Maximum number of scenes to judge on, taken from the start of the split."""
    timed_scenes: TimedScenes = 20
    """Maximum number of scenes, of these, on which core-seconds are measured; it takes several
    times as long as showing them once."""
    split: Literal["train", "validation", "test"] = "test"
    """Split to judge on."""
    train_data: tuple[str, ...] = ()
    """Datasets whose training pictures are looked up for the nearest one; by default the set itself
    if it has any, else the other scenes of the split."""
    lpips: str | None = None
    """Folder of the LPIPS weights, or hub to download them; by default the value of TRILIGHT_LPIPS,
    and without either LPIPS is n/a."""
    out: Path = Path("leaderboard")
    """Folder for table, chart and rows; asked again with the same folder, it goes on where it
    stopped."""
