"""Options of a training run, for the command line and Prefect's form."""

import sys
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any, Literal

from storage.errors import TrilightError
from storage.extensions import function_name
from storage.settings.described import checked
from storage.settings.overrides import option_words
from storage.settings.ranges import Within
from train.presets import override_training_preset
from train.resume import StartOptions
from train.settings import TrainSettings


@checked()
class _RunOptions:
    """First options of a training run."""

    run: str = "smoke"
    """Training preset, such as tiny or pretrain; `trilight presets` lists them."""
    data: tuple[str, ...] = ("data/smoke",)
    """Dataset (a folder or a URL), or shards by name or pattern. Several are mixed by the setting
    data_weights; a pattern is such as s3://b/{train-000000,validation-000002}.tar."""
    out: str | None = None
    """Folder for the run, on the machine that trains; by default runs/PRESET."""


@checked()
class TrainOptions(StartOptions, _RunOptions):
    """Training run, data and start."""

    device: Literal["cpu", "cuda"] | None = None
    """Device to compute on; by default cuda if there is one, else cpu."""
    steps: Annotated[int | None, Within(1, 10**9, unit="steps")] = None
    """Number of steps; by default the run's. Fewer steps also shorten the warm-up and the
    intervals."""
    most_unusable: Annotated[int | None, Within(0, 10**9, unit="samples")] = None
    """Maximum number of unusable samples to replace; by default the first one stops the run."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to settings by dotted name, such as model=large (JSON values); by default none."""
    workers: Annotated[int | None, Within(0, 1024, unit="threads")] = None
    """Threads of each process that decode samples, with 0 the main thread; by default the cores
    that the network leaves free, at most 8. Batches are the same with any number."""
    processes: Annotated[int, Within(1, 1024, unit="processes")] = 1
    """Processes on this machine, started by torchrun; use one for each GPU."""

    def __post_init__(self) -> None:
        if not self.data:
            raise TrilightError("data is empty; expected at least one dataset.")

    @property
    def place(self) -> str:
        """Folder of the run."""
        return f"runs/{function_name(self.run)}" if self.out is None else self.out

    def settings(self) -> TrainSettings:
        """Return the settings of the run.

        Raises:
            TrilightError: an unknown preset or setting, a refused value, or start options that do
                not fit the run.
        """
        settings = override_training_preset(
            self.run, self.changes, steps=self.steps, most_unusable=self.most_unusable
        )
        self.check(settings)
        return settings

    def command(self) -> list[str]:
        """Return the command line that trains."""
        launch = ["-m", "trilight"]
        if self.processes > 1:
            several = f"--nproc-per-node={self.processes}"
            launch = ["-m", "torch.distributed.run", "--standalone", several, *launch]
        options = option_words(self, leave_out=("run", "processes"))
        return [sys.executable, *launch, "train", self.run, *options]
