"""`TrainOrder`: everything a user asks of a training run, by command line or Prefect's form."""

import os
import sys
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any, Literal

from storage.errors import TrilightError
from storage.extensions import function_name
from storage.settings.described import checked, option_words
from storage.settings.ranges import Within
from train.runs import changed_run
from train.settings import TrainSettings
from train.start import Start

RESTARTS = "TORCHELASTIC_RESTART_COUNT"
"""Variable in which torchrun counts how often it has started its processes again."""


@checked()
class TrainOrder:
    """Which run to train, on what, and how."""

    run: str = "smoke"
    """Name of a run (a named set of settings), such as smoke or pretrain."""
    data: tuple[str, ...] = ("data/smoke",)
    """Dataset (a folder or a URL); several, which are mixed as the setting data_weights says; or
    shards by name or pattern, such as s3://b/{train,validation}-{000000..000007}.tar."""
    out: str | None = None
    """Folder for the run, on the machine that trains; by default runs/RUN."""
    resume: bool = False
    """Continue from the newest checkpoint. Settings are stated as at the start; those of how it is
    executed may differ."""
    restartable: bool = False
    """Resume if the folder has a checkpoint, else begin, so that a scheduler may start the same
    command again and again. A restart by torchrun does so anyway."""
    branch: str | None = None
    """Checkpoint, or folder of a run, to continue from in a new folder (--out), which then goes its
    own way; by default there is none."""
    decisions: Mapping[str, Any] = field(default_factory=dict)
    """Changes to what the run means, with --resume or --branch, such as num_steps=20000 or
    learning_rate=1e-4; they hold from the checkpoint on and are recorded; by default there are
    none."""
    begin_with: str | None = None
    """Folder of a run, or checkpoint, with the initial weights of a finetune run; by default, and
    in all other runs, they are random."""
    lpips: str | None = None
    """Folder of the LPIPS weights (vgg16-397923af.pth and vgg.pth), or hub to download them; by
    default the value of TRILIGHT_LPIPS."""
    device: Literal["cpu", "cuda"] | None = None
    """Device to compute on; by default cuda if there is one, else cpu."""
    steps: Annotated[int | None, Within(1, 10**9, unit="steps")] = None
    """Number of steps; by default the run's. Fewer steps also shorten the warm-up and the
    intervals."""
    most_unusable: Annotated[int | None, Within(0, 10**9, unit="samples")] = None
    """Maximum number of unusable samples to replace by others; by default the first one stops the
    run."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the run's settings, by dotted name, such as loss.perceptual=none or model=large
    (values are JSON); by default there are none."""
    workers: Annotated[int | None, Within(0, 1024, unit="threads")] = None
    """Threads of each process that decode samples, with 0 the main one; by default as many as its
    share of the cores leaves beside the network, at most 8. Batches are the same with any number.
    """
    processes: Annotated[int, Within(1, 1024, unit="processes")] = 1
    """Number of processes on this machine, which torchrun starts; use one for each graphics card.
    """

    def __post_init__(self) -> None:
        if not self.data:
            raise TrilightError("data is empty; expected at least one dataset.")

    @property
    def place(self) -> str:
        """The folder of the run."""
        return f"runs/{function_name(self.run)}" if self.out is None else self.out

    def settings(self) -> TrainSettings:
        """Return the settings of the run.

        Raises:
            TrilightError: no such run or setting, a value that is refused, or a start that is not
                the run's.
        """
        settings = changed_run(
            self.run, self.changes, steps=self.steps, most_unusable=self.most_unusable
        )
        self.start().check(settings)
        return settings

    def start(self) -> Start:
        """Return how the run begins."""
        return Start(
            resume=self.resume,
            restartable=self.restartable or int(os.environ.get(RESTARTS, "0")) > 0,
            branch=self.branch,
            decisions=self.decisions,
            begin_with=self.begin_with,
            lpips=self.lpips,
        )

    def command(self) -> list[str]:
        """Return the command line that trains."""
        launch = ["-m", "trilight"]
        if self.processes > 1:
            several = f"--nproc-per-node={self.processes}"
            launch = ["-m", "torch.distributed.run", "--standalone", several, *launch]
        options = option_words(self, leave_out=("run", "processes"))
        return [sys.executable, *launch, "train", self.run, *options]
