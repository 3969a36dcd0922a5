"""Options of `trilight evaluate` and `leaderboard`. Imports no torch."""

from pathlib import Path
from typing import Annotated, Literal

from storage.aliases import NETWORKS, stored_name
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.fields import option_of
from storage.settings.ranges import Within
from train.folder import RunFolder

Width = Annotated[int, Within(1, 8192, unit="pixels")]
"""Width of an image in pixels."""
SceneCount = Annotated[int, Within(1, 10**9, unit="scenes")]
"""Maximum number of scenes to evaluate."""


@checked()
class JudgeOptions:
    """Data of an evaluation or a leaderboard."""

    pictures: tuple[Path, ...] = ()
    """Folders of OpenEXR images from elsewhere for the leaderboard, named as export names them; by
    default none. Each has one image a view, such as 000000003_view_0.exr."""
    split: Literal["train", "validation", "test"] = "test"
    """Split of the dataset to evaluate on."""
    train_data: tuple[str, ...] = ()
    """Datasets whose training images the baselines use; by default those of the dataset itself. A
    leaderboard looks up the other scenes of the split where there are none."""
    lpips: str | None = None
    """Folder of the LPIPS weights, or hub to download them; by default the value of TRILIGHT_LPIPS,
    and without either LPIPS is n/a."""


@checked()
class LeaderboardOptions(JudgeOptions):
    """Dataset, networks and images."""

    source: str
    """Dataset (folder or URL) with images, such as one of preset benchmark-v1."""
    checkpoint: tuple[str, ...] = ()
    """Networks in addition to the built-in ones; by default none. A network is a run, weights, or a
    name on the Hugging Face hub such as microsoft/renderformer-v1-base. All other rows are compared
    with the first one."""
    width: tuple[Width, ...] = ()
    """Widths of images in pixels, divisors of the dataset's; by default those of 64, 256 and 512
    that divide it, else the dataset's own."""
    scenes: SceneCount = 10**6
    """Maximum number of scenes, from the start of the split."""
    timed_scenes: Annotated[int, Within(1, 10**6, unit="scenes")] = 20
    """Maximum number of scenes on which CPU seconds are measured."""
    out: Path = Path("leaderboard")
    """Folder for table, chart and rows; with existing rows a run resumes."""

    def __post_init__(self) -> None:
        stored = tuple(stored_name(each, NETWORKS) for each in self.checkpoint)
        object.__setattr__(self, "checkpoint", stored)  # each network once, under one name


@checked()
class EvaluationOptions(JudgeOptions):
    """Network to evaluate, and the data to use."""

    checkpoint: str | None = None
    """Folder of a run, model.safetensors, a checkpoint, or default for the included network; by
    default none. Without one, all methods are compared as by trilight leaderboard."""
    data: tuple[str, ...]
    """Dataset (a folder or a URL), or shards by name or pattern."""
    other_networks: tuple[str, ...] = ()
    """Networks to compare it with on a leaderboard of all methods, which is written into the same
    folder; by default none."""
    resolution: Width | None = None
    """Width of an image in pixels, which divides the dataset's; by default the run's if known,
    else the dataset's."""
    most_scenes: SceneCount = 10**6
    """Maximum number of scenes to evaluate, taken from the start of the split."""
    tracer_views: Annotated[int, Within(0, 10**6, unit="views")] = 64
    """Maximum number of views on which the denoised path tracer is judged in the network's own
    time; 0 leaves it out."""
    device: Literal["cpu", "cuda"] | None = None
    """Device to compute on; by default cuda if there is one, else cpu."""
    out: Path | None = None
    """Folder for the report; by default evaluation, in the folder of a run or else here, and
    leaderboard without a network. Where the report of another network is, a number is added."""

    @property
    def report_folder(self) -> Path:
        """Folder of the report, unless it holds another network's report."""
        checkpoint = Path(self.checkpoint or "")
        for folder in (checkpoint, *list(checkpoint.parents)[:2]):
            if self.checkpoint and self.out is None and RunFolder(folder).settings.is_file():
                return folder / "evaluation"
        return self.out or Path("evaluation" if self.checkpoint else "leaderboard")

    def leaderboard(self) -> LeaderboardOptions | None:
        """Return the options of the leaderboard; None if none was requested.

        Raises:
            TrilightError: there are several datasets, or an option has no effect without a network.
        """
        if self.checkpoint and not (self.other_networks or self.pictures):
            return None
        for option, value in (("device", self.device), ("tracer_views", self.tracer_views)):
            if not self.checkpoint and value != getattr(EvaluationOptions, option):
                raise TrilightError(
                    f"{option_of(option)} is {value!r} and no network is named; expected both or "
                    "neither. Without one, all methods are compared on the processor."
                )
        if len(self.data) > 1:
            raise TrilightError(
                f"--data is given {len(self.data)} times; expected one dataset to compare methods "
                "on. Compare on one after the other."
            )
        return LeaderboardOptions(
            source=self.data[0],
            checkpoint=(*filter(None, [self.checkpoint]), *self.other_networks),
            width=(self.resolution,) if self.resolution else (),
            scenes=self.most_scenes,
            out=self.report_folder,
            **{name: getattr(self, name) for name in JudgeOptions.__annotations__},
        )
