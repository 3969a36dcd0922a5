"""`trilight render`: renders scenes by path tracing, by a trained network, or by both."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.text import Text

from infra.cli.console import Bars, print_result, suggest_look
from infra.cli.options import command
from infra.render.networks import NetworkRenderer
from infra.render.path_tracer import PathTracer
from infra.render.plan import RenderOptions, RenderPlan, plan_render
from infra.render.run_render import FinishedShot, run_plan
from infra.render.tone_mapping import enlargement
from pipeline.exchange.reader import SceneReader
from pipeline.renders.calibrated_error import OUTSIDE, promise_sentence
from pipeline.renders.preview import PreviewSettings
from pipeline.renders.settings import RenderSettings
from storage.renderer import Facts, Image, Renderer, Sampling


@command("source")
def render(options: RenderOptions) -> None:
    started = time.monotonic()
    with Bars() as bars, SceneReader() as reader:
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


Rows = list[tuple[str, str]]

_STATED = {
    "psnr_log_db": ("noise_floor_db", "expected_error_db", ""),
    "psnr_linear_db": (
        "noise_floor_linear_db", "expected_error_linear_db", ": linear, clamped to [0, 1]"
    ),
    "object_psnr_log_db": (
        "object_noise_floor_db", "object_expected_error_db", ": where geometry is seen"
    ),
}  # fmt: skip
"""By the metric of a stated error: its fact, that of the expected error, and what it means."""

_FILTERS = {"fast": "one fast denoise", "high": "one denoise", "off": "not denoised"}


def print_outcome(
    plan: RenderPlan, finished: Sequence[FinishedShot], notes: Sequence[str], seconds: float
) -> None:
    """Print files and figures of the only picture, or a summary of many."""
    record: dict[str, Any] = {
        "engine": "both" if len(plan.renderers) > 1 else plan.renderers[0].name,
        "notes": list(notes),
        "resolution": plan.resolution,
        "seconds": round(seconds, 2),
        "source": plan.source,
        "view": plan.view,
    }
    if plan.choice is not None:
        record["choice"] = plan.choice.sentence
    shots = [_shot_json(shot, timed=plan.choice is not None) for shot in finished]
    if plan.output.is_sequence:
        video = plan.output.video
        record |= {"pictures": shots, "video": None if video is None else str(video)}
        rows = _sequence_rows(plan, finished)
        look = str(video or plan.output.folder)
        measured = f"the pictures in {plan.output.folder}"
    else:
        (shot,) = finished
        record |= shots[0]
        rows = _picture_rows(plan, shot)
        look = str(shot.png)
        measured = " and ".join(str(picture.path) for picture in shot.pictures.values())
    rows += [*_time_rows(plan, finished), ("wall time", f"{seconds:.1f} s")]
    if not plan.output.is_sequence:
        rows.append(("scene digest", finished[0].scene_sha256))
    print_result("Rendered", rows, record, notes=notes)
    suggest_look(f"Look at {look}; measure with {measured}")


def _shot_json(done: FinishedShot, *, timed: bool) -> dict[str, Any]:
    """Return the figures of one shot; those of a single renderer are not nested."""
    by_renderer: dict[str, Any] = {}
    for name, picture in done.pictures.items():
        facts: dict[str, Any] = {**picture.facts}
        if "at_cap" in facts:
            facts["at_cap"] = bool(facts["at_cap"])
        if timed:
            seconds = picture.seconds
            facts["picture_seconds"] = None if seconds is None else float(f"{seconds:.4g}")
        by_renderer[name] = {**facts, "exr": str(picture.path), "kept": picture.seconds is None}
    if len(by_renderer) == 1:
        (by_renderer,) = by_renderer.values()
    else:
        by_renderer = {**by_renderer, "psnr_log_db": round(done.psnr_log_db or 0, 3)}
        if done.flicker is not None:
            rounded = {name: round(value, 3) for name, value in done.flicker.items()}
            by_renderer["flicker"] = rounded
    return {
        "lights": done.num_lights,
        "png": str(done.png),
        "scene_sha256": done.scene_sha256,
        "triangles": done.num_triangles,
        **by_renderer,
    }


def _picture_rows(plan: RenderPlan, done: FinishedShot) -> Rows:
    width = plan.resolution
    factor = enlargement(width)
    enlarged = "" if factor == 1 else f"; in the PNG a pixel is {factor} x {factor}"
    rows: Rows = [
        (
            "scene",
            f"{plan.source}, view {plan.view}; triangles: {done.num_triangles}, "
            f"lights: {done.num_lights}",
        ),
        ("picture", f"{width} x {width}, linear radiance{enlarged}"),
    ]
    for renderer in plan.renderers:
        rows += _describe(renderer, done.pictures[renderer.name].facts)
    if done.psnr_log_db is not None:
        rows.append(("agreement", f"{done.psnr_log_db:.1f} dB (psnr_log_db)"))
    return rows


def _describe(renderer: Renderer, facts: Facts) -> Rows:
    match renderer:
        case PathTracer(settings=PreviewSettings() as preview):
            unknown = "unknown: a preview measures none"
            samples = f"{facts['spp']}, {_FILTERS[preview.denoiser]}"
            return [("samples per pixel", samples), ("stated error", unknown)]
        case PathTracer(settings=RenderSettings() as settings):
            floors = [_floor(settings, facts, metric) for metric in _shown_metrics(settings)]
            rows = [("stated error", floors[0]), *(("", floor) for floor in floors[1:])]
            if settings.stated_error == "calibrated":
                bound = f"a bound: pictures like this one are not calibrated ({OUTSIDE})"
                promise = promise_sentence(settings.resolution)
                rows.append(("", promise if "expected_error_db" in facts else bound))
            mean = f"{facts['mean_radiance']:.4g} (radiance), that of its samples"
            rows = [
                ("samples per pixel", f"{facts['spp']} on average"),
                *rows,
                ("mean brightness", mean),
            ]
            for part in settings.part_names:
                floor_db = float(facts[f"{part}.noise_floor_db"])
                rows.append((f"layer {part}", f"{floor_db:.1f} dB (psnr_log_db)"))
            return rows
        case NetworkRenderer():
            return [("network", f"{renderer.checkpoint}; passes: {facts['passes']}")]
    raise TypeError(f"{renderer.name} is a renderer without a description")


def _shown_metrics(settings: RenderSettings) -> list[str]:
    """Return the metrics of the stated errors that were asked for; JSON has all three."""
    return [metric for metric in _STATED if metric in settings.targets_db] or ["psnr_log_db"]


def _floor(settings: RenderSettings, facts: Facts, metric: str) -> str:
    """Return the text of one stated error, and whether its target was reached."""
    stated, expected, means = _STATED[metric]
    floor_db = float(facts[stated])
    target_db = settings.targets_db.get(metric)
    probably = f", probably {float(facts[expected]):.1f}" if expected in facts else ""
    text = f"{floor_db:.1f} dB{probably} ({metric}{means}"
    if target_db is None:
        return f"{text})"
    reached = floor_db >= target_db or not facts["at_cap"]  # facts are rounded
    return f"{text}; {'reached' if reached else 'the cap came before'} {target_db:g} dB)"


def _sequence_rows(plan: RenderPlan, shots: Sequence[FinishedShot]) -> Rows:
    pictures = [picture for shot in shots for picture in shot.pictures.values()]
    num_kept = sum(picture.seconds is None for picture in pictures)
    rows: Rows = [
        ("pictures", f"{len(shots)} of {plan.resolution} x {plan.resolution}"),
        ("files", f"{len(pictures)}, of which {num_kept} were there already"),
    ]
    agreements = [shot.psnr_log_db for shot in shots if shot.psnr_log_db is not None]
    for renderer in plan.renderers:
        match renderer:
            case PathTracer(settings=RenderSettings() as settings):
                for metric in _shown_metrics(settings):
                    stated = [shot.pictures[renderer.name].facts for shot in shots]
                    values = [float(facts[_STATED[metric][0]]) for facts in stated]
                    rows += _spread("stated error", values, metric)
    rows += _spread("agreement", agreements, "psnr_log_db")
    if flickers := [shot.flicker for shot in shots if shot.flicker is not None]:
        db = np.median([flicker["db"] for flicker in flickers])
        noise_db = np.median([flicker["noise_db"] for flicker in flickers])
        text = f"median {db:.1f} dB from frame to frame; the traced frames' noise alone"
        rows.append(("flicker", f"{text} {noise_db:.1f}"))
    return rows


def _time_rows(plan: RenderPlan, shots: Sequence[FinishedShot]) -> Rows:
    """Return measured and expected seconds, where --seconds or --error chose."""
    taken = [each.seconds for shot in shots for each in shot.pictures.values() if each.seconds]
    if plan.choice is None or not taken:
        return []
    which = "" if len(taken) == 1 else f"median of {len(taken)}: "
    text = f"{which}{np.median(taken):.2g} s after start-up"
    return [("picture took", f"{text}; expected {plan.choice.priced.seconds:.2g} s")]


def _spread(name: str, values_db: Sequence[float], metric: str) -> Rows:
    if not values_db:
        return []
    median = np.median(values_db)
    low = np.percentile(values_db, 5)
    return [(name, f"median {median:.1f} dB, 5th percentile {low:.1f} dB ({metric})")]
