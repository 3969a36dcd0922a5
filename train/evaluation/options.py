"""Options of an evaluation. Imports no torch."""

from pathlib import Path
from typing import Annotated, Literal

from storage.settings.described import checked
from storage.settings.ranges import Within
from train.folder import RunFolder

Width = Annotated[int, Within(1, 8192, unit="pixels")]
"""Width of a picture in pixels."""
SceneCount = Annotated[int, Within(1, 10**9, unit="scenes")]
"""Maximum number of scenes to evaluate."""
TracedViews = Annotated[int, Within(0, 10**6, unit="views")]
"""Maximum number of views for the path tracer."""


@checked()
class EvaluationOptions:
    """Network to evaluate, and the data to use."""

    checkpoint: str
    """Folder of a run, model.safetensors or a checkpoint; builtin: is the network that comes with
    Trilight."""
    data: tuple[str, ...]
    """Dataset (a folder or a URL), or shards by name or pattern."""
    split: Literal["train", "validation", "test"] = "test"
    """Split of the dataset to evaluate on."""
    train_data: tuple[str, ...] = ()
    """Datasets whose training pictures the baselines use; by default those of --data, if they have
    any."""
    resolution: Width | None = None
    """Width of a picture in pixels, which divides the dataset's; by default the run's if known,
    else the dataset's."""
    most_scenes: SceneCount = 10**6
    """Maximum number of scenes to evaluate, taken from the start of the split."""
    tracer_views: TracedViews = 64
    """Maximum number of views to judge the path tracer on as well, denoised, with the samples that
    take it the network's own time; 0 leaves it out."""
    lpips: str | None = None
    """Folder of the LPIPS weights, or hub to download them; by default the value of TRILIGHT_LPIPS,
    and without either LPIPS is n/a."""
    device: Literal["cpu", "cuda"] | None = None
    """Device to compute on; by default cuda if there is one, else cpu."""
    out: Path | None = None
    """Folder for the report; by default evaluation, in the folder of a run or else here. Where the
    report of another network is, a number is added."""

    @property
    def report_folder(self) -> Path:
        """Folder of the report, unless it holds another network's report."""
        checkpoint = Path(self.checkpoint)
        for folder in (checkpoint, *list(checkpoint.parents)[:2]):
            if self.out is None and RunFolder(folder).settings.is_file():
                return folder / "evaluation"
        return self.out or Path("evaluation")
