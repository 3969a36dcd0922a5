"""What `trilight render` says when it is done."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.text import Text

from infra.cli.console import console, print_json, print_rows
from infra.rendering.comparison import Flicker
from infra.rendering.engines import EnginePlan, Facts, MitsubaPlan, NeuralPlan
from infra.rendering.look import enlargement
from infra.rendering.plan import RenderPlan
from infra.rendering.run import FinishedShot, RenderOutcome

Rows = list[tuple[str, str]]


def print_outcome(outcome: RenderOutcome, seconds: float, *, as_json: bool) -> None:
    """Print files and figures: of the only picture, or summed up over all."""
    plan = outcome.plan
    if as_json:
        shots = [_shot_json(shot) for shot in outcome.shots]
        common = {
            "engine": plan.engine,
            "notes": list(outcome.notes),
            "resolution": plan.resolution,
            "seconds": round(seconds, 2),
            "source": plan.source,
            "view": plan.view,
        }
        if not plan.place.is_sequence:
            print_json({**common, **shots[0]})
            return
        video = plan.place.video
        print_json({**common, "pictures": shots, "video": None if video is None else str(video)})
        return
    for note in outcome.notes:
        console.print(Text(f"Note: {note}.", style="yellow"))
    if plan.place.is_sequence:
        _print_sequence(plan, outcome.shots, seconds)
    else:
        _print_one(plan, outcome.shots[0], seconds)


def _shot_json(done: FinishedShot) -> dict[str, Any]:
    """Return the figures of one shot; with one engine they stand beside those of the scene."""
    of_engines: Mapping[str, Any] = {
        name: {**picture.facts, "exr": str(picture.path), "kept": picture.was_kept}
        for name, picture in done.pictures.items()
    }
    for facts in of_engines.values():
        if "at_cap" in facts:
            facts["at_cap"] = bool(facts["at_cap"])
    if len(of_engines) == 1:
        (of_engines,) = of_engines.values()
    else:
        of_engines = {**of_engines, "psnr_log_db": round(done.psnr_log_db or 0, 3)}
        if done.flicker is not None:
            flicker = dataclasses.asdict(done.flicker)
            of_engines["flicker"] = {name: round(value, 3) for name, value in flicker.items()}
    return {
        "lights": done.scene.num_lights,
        "png": str(done.shot.png),
        "scene_sha256": done.scene.digest,
        "triangles": done.scene.num_triangles,
        **of_engines,
    }


def _print_one(plan: RenderPlan, done: FinishedShot, seconds: float) -> None:
    scene, width = done.scene, plan.resolution
    factor = enlargement(width)
    enlarged = "" if factor == 1 else f"; in the PNG a pixel is {factor} x {factor}"
    rows: Rows = [
        (
            "scene",
            f"{plan.source}, view {plan.view}; triangles: {scene.num_triangles}, "
            f"lights: {scene.num_lights}",
        ),
        ("picture", f"{width} x {width}, linear radiance{enlarged}"),
    ]
    for engine in plan.engines:
        rows += _engine(engine, done.pictures[engine.name].facts)
    if done.psnr_log_db is not None:
        rows.append(("agreement", f"{done.psnr_log_db:.1f} dB (psnr_log_db)"))
    rows += [("wall time", f"{seconds:.1f} s"), ("scene digest", scene.digest)]
    print_rows("Rendered", rows)
    measure = " and ".join(str(picture.path) for picture in done.pictures.values())
    console.print(f"\nLook at {done.shot.png}; measure with {measure}", style="bold")


def _engine(engine: EnginePlan, facts: Facts) -> Rows:
    match engine:
        case MitsubaPlan():
            reached = "the cap came before" if facts["at_cap"] else "reached"
            target = f"{reached} {engine.settings.noise_floor_db:g} dB"
            return [
                ("samples per pixel", f"{facts['spp']}"),
                ("noise floor", f"{facts['noise_floor_db']:.1f} dB (psnr_log_db; {target})"),
                ("", f"{facts['object_noise_floor_db']:.1f} dB where geometry is seen"),
                ("", f"{facts['noise_floor_linear_db']:.1f} dB linear, clamped to [0, 1]"),
            ]
        case NeuralPlan():
            return [("network", f"{engine.checkpoint}; passes: {facts['passes']}")]
    raise TypeError(f"{engine.name} is an engine without a description")


def _print_sequence(plan: RenderPlan, shots: Sequence[FinishedShot], seconds: float) -> None:
    pictures = [picture for shot in shots for picture in shot.pictures.values()]
    kept = Counter(picture.was_kept for picture in pictures)[True]
    rows: Rows = [
        ("pictures", f"{len(shots)} of {plan.resolution} x {plan.resolution}"),
        ("files", f"{len(pictures)}, of which {kept} were there already"),
    ]
    floors = [
        float(picture.facts["noise_floor_db"])
        for picture in pictures
        if "noise_floor_db" in picture.facts
    ]
    agreements = [shot.psnr_log_db for shot in shots if shot.psnr_log_db is not None]
    rows += _spread("noise floor", floors) + _spread("agreement", agreements)
    rows += _flicker([shot.flicker for shot in shots if shot.flicker is not None])
    rows.append(("wall time", f"{seconds:.1f} s"))
    print_rows("Rendered", rows)
    folder = plan.place.folder
    look = plan.place.video or folder
    console.print(f"\nLook at {look}; measure with the pictures in {folder}", style="bold")


def _spread(name: str, values_db: Sequence[float]) -> Rows:
    if not values_db:
        return []
    median, low = np.median(values_db), np.percentile(values_db, 5)
    return [(name, f"median {median:.1f} dB, 5th percentile {low:.1f} dB (psnr_log_db)")]


def _flicker(found: Sequence[Flicker]) -> Rows:
    if not found:
        return []
    median = np.median([flicker.db for flicker in found])
    noise = np.median([flicker.noise_db for flicker in found])
    text = f"median {median:.1f} dB from frame to frame; the traced frames' noise alone {noise:.1f}"
    return [("flicker", text)]
