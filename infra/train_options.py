"""Options of a training run, for the command line and Prefect's form."""

import os
import sys
from collections.abc import Mapping
from dataclasses import field, fields
from typing import Annotated, Any, Literal

from storage.errors import TrilightError
from storage.extensions import function_name
from storage.settings.described import checked
from storage.settings.overrides import option_words
from storage.settings.ranges import Within
from train.presets import override_training_preset
from train.resume import StartOptions
from train.settings import TrainSettings

RESTARTS = "TORCHELASTIC_RESTART_COUNT"
"""Environment variable in which torchrun counts the restarts of its processes."""


@checked()
class TrainOptions:
    """Training run, data and start."""

    run: str = "smoke"
    """Training preset, such as tiny or pretrain; `trilight presets` lists them."""
    data: tuple[str, ...] = ("data/smoke",)
    """Dataset (a folder or a URL), or shards by name or pattern. Several are mixed by the setting
    data_weights; a pattern is such as s3://b/{train-000000,validation-000002}.tar."""
    out: str | None = None
    """Folder for the run, on the machine that trains; by default runs/PRESET."""
    resume: bool = False
    """Continue from the newest checkpoint, with the settings of the start. Settings of execution
    may differ."""
    restartable: bool = False
    """Resume if the folder has a checkpoint, else begin. A scheduler may then start the same
    command repeatedly; a restart by torchrun always resumes."""
    branch: str | None = None
    """Checkpoint, or folder of a run, to continue in a new folder; by default none."""
    decisions: Mapping[str, Any] = field(default_factory=dict)
    """Recorded changes with --resume or --branch, such as num_steps=20000; by default none. They
    apply from the checkpoint on."""
    begin_with: str | None = None
    """Run folder or checkpoint with the initial weights of a finetune run; by default random
    weights."""
    lpips: str | None = None
    """Folder of vgg16-397923af.pth and vgg.pth (LPIPS), or hub; by default the value of
    TRILIGHT_LPIPS."""
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
        self.start().check(settings)
        return settings

    def start(self) -> StartOptions:
        """Return the start options of the run."""
        values = {each.name: getattr(self, each.name) for each in fields(StartOptions)}
        restarts = int(os.environ.get(RESTARTS, "0")) > 0
        return StartOptions(**values | {"restartable": self.restartable or restarts})

    def command(self) -> list[str]:
        """Return the command line that trains."""
        launch = ["-m", "trilight"]
        if self.processes > 1:
            several = f"--nproc-per-node={self.processes}"
            launch = ["-m", "torch.distributed.run", "--standalone", several, *launch]
        options = option_words(self, leave_out=("run", "processes"))
        return [sys.executable, *launch, "train", self.run, *options]
