"""`trilight render`: renders scenes by path tracing, by a trained network, or by both."""

import time

from rich.progress import Progress
from rich.text import Text

from infra.cli.console import progress_bars
from infra.cli.options import command
from infra.render.options import RenderOptions
from storage.renderer import Image, Sampling


@command("source")
def render(options: RenderOptions) -> None:
    from infra.cli.rendered import print_outcome
    from infra.render.plan import plan_render
    from infra.render.run_render import run_plan
    from pipeline.exchange.reader import SceneReader

    started = time.monotonic()
    with progress_bars() as bars, SceneReader(options.albedo_over_one) as reader:
        plan = plan_render(options, reader)
        if plan.choice is not None:
            bars.console.print(Text(plan.choice.sentence), soft_wrap=True)
        outcome = run_plan(plan, reader, _Bars(bars))
    print_outcome(outcome, time.monotonic() - started)


class _Bars:
    """Progress bars of finished pictures, and of the samples of the current one."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self._pictures = bars.add_task("pictures", total=None, note="", visible=False)
        self._samples = bars.add_task("samples", total=None, note="", visible=False)

    def on_picture(self, done: int, total: int) -> None:
        self._bars.update(self._pictures, completed=done, total=total, visible=True)

    def on_samples(self, now: Sampling | Image) -> None:
        if isinstance(now, Image):
            return
        note = "" if now.missing_db is None else f"{now.missing_db:.1f} dB to go"
        self._bars.update(
            self._samples,
            completed=min(now.spp, now.expected_spp),
            total=now.expected_spp,
            note=note,
            visible=True,
        )
