"""`ImproveOrder`: everything a user asks of a closed loop. Importing it loads no torch."""

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

from infra.improve.axes import strata_of
from infra.train_order import TrainOrder
from pipeline.builds.named import named_build
from pipeline.builds.settings import BuildSettings
from scene_templates.strata import Stratum
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import Share, Within

Axis = Literal["walls", "objects", "lights", "roughness"]
"""Name of an axis (infra.improve.axes.AXES)."""


@checked("improve")
class ImproveOrder:
    """Rounds of generate, train and judge, each drawing what the last one says is worth most."""

    build: str = "smoke"
    """Name of the build whose scenes are drawn."""
    objects: str | None = None
    """Source of 3D objects, as for generate; by default the build's own."""
    run: str = "hits"
    """Name of the run that is trained; its schedule becomes wsd, so that it can be made longer
    round by round, and its rate falls over half of the last round."""
    out: str = "improved"
    """Folder on this machine for the rounds, the run and the report; asked again with the same
    folder, it goes on where it stopped."""
    rounds: Annotated[int, Within(1, 999, unit="rounds")] = 4
    """Number of rounds. The first draws scenes as the build does; its validation split weighs the
    strata in every round, and nobody touches its test split."""
    scenes: Annotated[int, Within(2, 10**7, unit="scenes")] = 96
    """Training scenes of a round drawn as the build does. Later rounds make as many as cost the
    same core-seconds."""
    steps: Annotated[int, Within(2, 10**7, unit="steps")] = 200
    """Training steps of a round, on the scenes of all rounds so far."""
    floor: Share = 0.3
    """Share of every round's scenes that are drawn as the build does; with 1 all are, and there is
    no loop."""
    axes: tuple[Axis, ...] = ("walls", "lights", "roughness")
    """Axes along which scenes are told apart; each halves the strata."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the build's settings, by dotted name; by default there are none."""
    run_changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes to the run's settings, by dotted name; by default there are none."""
    device: Literal["cpu", "cuda"] | None = None
    """Device to train on; by default cuda if there is one, else cpu."""

    def __post_init__(self) -> None:
        if "://" in self.out:
            raise TrilightError(
                f"out is {self.out!r}; expected a folder of this machine, since rounds read their "
                "own files again."
            )
        self.strata()
        self.training(1, ("data",), None).settings()

    @property
    def root(self) -> Path:
        """The folder of everything."""
        return Path(self.out)

    def settings(self) -> BuildSettings:
        """Return the build with its changes, without strata."""
        return named_build(self.build, changes=self.changes)

    def strata(self) -> tuple[Stratum, ...]:
        """Return the strata, weighted as the build draws them.

        Raises:
            TrilightError: an axis that the build does not have, or a build with one split alone.
        """
        settings = self.settings()
        if settings.splits.one_split:
            raise TrilightError(
                f"improve: build {self.build} has the split test alone; expected one with scenes "
                "to train on, such as smoke."
            )
        return strata_of(settings.scenes, self.axes)

    def training(self, number: int, data: tuple[str, ...], data_digest: str | None) -> TrainOrder:
        """Return the training of a round, counted from 1.

        Args:
            number: of the round.
            data: datasets of all rounds so far.
            data_digest: of them together, as a decision names data; None in the first round.
        """
        # constant until the last round, over whose second half the rate falls
        falls = {"decay_share": 0.5 / number} if number == self.rounds else {}
        decisions: dict[str, Any] = {}
        if number > 1:
            decisions = {"num_steps": number * self.steps, "data": data_digest, **falls}
        alone = falls if self.rounds == 1 else {}
        return TrainOrder(
            run=self.run,
            data=data,
            out=str(self.root / "run"),
            restartable=True,
            device=self.device,
            steps=self.steps,
            changes={**self.run_changes, "schedule": "wsd", "decay_share": 0.0, **alone},
            decisions=decisions,
        )


PLACES = ("out", "device")
"""Fields that decide nothing of the result."""
