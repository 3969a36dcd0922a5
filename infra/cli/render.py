"""`trilight render`: renders scenes by path tracing, by a trained network, or by both."""

import time

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
        names = ("pictures", "samples")
        pictures, samples = (
            bars.add_task(name, total=None, note="", visible=False) for name in names
        )

        def on_picture(done: int, total: int) -> None:
            bars.update(pictures, completed=done, total=total, visible=True)

        def on_samples(now: Sampling | Image) -> None:
            if not isinstance(now, Image):
                note = "" if now.missing_db is None else f"{now.missing_db:.1f} dB to go"
                done = min(now.spp, now.expected_spp)
                total = now.expected_spp
                bars.update(samples, completed=done, total=total, note=note, visible=True)

        shots, notes = run_plan(plan, reader, on_picture, on_samples)
    print_outcome(plan, shots, notes, time.monotonic() - started)
