"""`trilight render`: pictures of scenes, by path tracing, by a trained network, or by both."""

import time
from typing import TYPE_CHECKING

from rich.progress import Progress
from rich.text import Text

from infra.cli.console import progress_bars
from infra.cli.options import Shown, command
from infra.rendering.request import Asked

if TYPE_CHECKING:
    from infra.rendering.ways import Choice
    from pipeline.renders.results import Sampling


@command("source")
def render(asked: Asked, shown: Shown) -> None:
    from infra.cli.rendered import print_outcome
    from infra.rendering.run import render_asked

    started = time.monotonic()
    with progress_bars() as bars:
        outcome = render_asked(asked, _Bars(bars, visible=not shown.json))
    print_outcome(outcome, time.monotonic() - started, as_json=shown.json)


class _Bars:
    """Shows how many pictures are finished, and how many samples the one at hand has."""

    def __init__(self, bars: Progress, *, visible: bool) -> None:
        self._bars = bars
        self._pictures = bars.add_task("pictures", total=None, note="", visible=False)
        self._samples = bars.add_task("samples", total=None, note="", visible=False)
        self._visible = visible

    def chosen(self, choice: "Choice") -> None:
        if self._visible:
            self._bars.console.print(Text(choice.sentence), soft_wrap=True)

    def pictures(self, done: int, total: int) -> None:
        self._bars.update(self._pictures, completed=done, total=total, visible=self._visible)

    def sampled(self, now: "Sampling") -> None:
        note = "" if now.missing_db is None else f"{now.missing_db:.1f} dB to go"
        self._bars.update(
            self._samples,
            completed=now.spp,
            total=now.expected_spp,
            note=note,
            visible=self._visible,
        )
