"""What `trilight render` says when it is done."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.text import Text

from infra.cli.console import console, print_json, print_rows
from infra.rendering.asked import Asked
from infra.rendering.look import enlargement
from infra.rendering.picture_file import PictureFile
from infra.rendering.run import FinishedShot, Flicker
from infra.rendering.session import RenderOutcome

Rows = list[tuple[str, str]]


def print_outcome(outcome: RenderOutcome, seconds: float, *, as_json: bool) -> None:
    """Print files and figures: of the only picture, or summed up over all."""
    asked = outcome.asked
    if as_json:
        shots = [_shot_json(shot) for shot in outcome.shots]
        common = {
            "engine": asked.engine,
            "notes": list(outcome.notes),
            "resolution": asked.resolution,
            "seconds": round(seconds, 2),
            "source": asked.source,
            "view": asked.view,
        }
        if not outcome.place.is_sequence:
            print_json({**common, **shots[0]})
            return
        video = outcome.place.video
        print_json({**common, "pictures": shots, "video": None if video is None else str(video)})
        return
    for note in outcome.notes:
        console.print(Text(f"Note: {note}.", style="yellow"))
    if outcome.place.is_sequence:
        _print_sequence(asked, outcome, seconds)
    else:
        _print_one(asked, outcome, seconds)


def _shot_json(shot: FinishedShot) -> dict[str, Any]:
    """Return the figures of one shot; with one engine they stand beside those of the scene."""
    of_engines: Mapping[str, Any] = {
        name: {**picture.facts, "exr": str(picture.path), "kept": picture.was_kept}
        for name, picture in shot.pictures.items()
    }
    for facts in of_engines.values():
        if "at_cap" in facts:
            facts["at_cap"] = bool(facts["at_cap"])
    if len(of_engines) == 1:
        (of_engines,) = of_engines.values()
    else:
        of_engines = {**of_engines, "psnr_log_db": round(shot.psnr_log_db or 0, 3)}
        if shot.flicker is not None:
            flicker = dataclasses.asdict(shot.flicker)
            of_engines["flicker"] = {name: round(value, 3) for name, value in flicker.items()}
    return {
        "lights": shot.scene.num_lights,
        "png": str(shot.png),
        "scene_sha256": shot.scene.digest,
        "triangles": shot.scene.num_triangles,
        **of_engines,
    }


def _print_one(asked: Asked, outcome: RenderOutcome, seconds: float) -> None:
    (shot,) = outcome.shots
    scene = shot.scene
    rows: Rows = [
        (
            "scene",
            f"{asked.source}, view {asked.view}; triangles: {scene.num_triangles}, "
            f"lights: {scene.num_lights}",
        ),
        ("picture", f"{asked.resolution} x {asked.resolution}, linear radiance{_enlarged(asked)}"),
    ]
    for name, picture in shot.pictures.items():
        rows += _traced(picture, outcome) if name == "mitsuba" else _neural(asked, picture)
    if shot.psnr_log_db is not None:
        rows.append(("agreement", f"{shot.psnr_log_db:.1f} dB (psnr_log_db)"))
    rows += [("wall time", f"{seconds:.1f} s"), ("scene digest", scene.digest)]
    print_rows("Rendered", rows)
    measure = " and ".join(str(picture.path) for picture in shot.pictures.values())
    console.print(f"\nLook at {shot.png}; measure with {measure}", style="bold")


def _enlarged(asked: Asked) -> str:
    assert asked.resolution is not None
    factor = enlargement(asked.resolution)
    return "" if factor == 1 else f"; in the PNG a pixel is {factor} x {factor}"


def _traced(picture: PictureFile, outcome: RenderOutcome) -> Rows:
    facts, target = picture.facts, outcome.settings.noise_floor_db
    reached = "the cap came before" if facts["at_cap"] else "reached"
    return [
        ("samples per pixel", f"{facts['spp']}"),
        ("noise floor", f"{facts['noise_floor_db']:.1f} dB (psnr_log_db; {reached} {target:g} dB)"),
        ("", f"{facts['object_noise_floor_db']:.1f} dB where geometry is seen"),
        ("", f"{facts['noise_floor_linear_db']:.1f} dB linear, clamped to [0, 1]"),
    ]


def _neural(asked: Asked, picture: PictureFile) -> Rows:
    return [("network", f"{asked.checkpoint}; passes: {picture.facts['passes']}")]


def _print_sequence(asked: Asked, outcome: RenderOutcome, seconds: float) -> None:
    pictures = [picture for shot in outcome.shots for picture in shot.pictures.values()]
    kept = Counter(picture.was_kept for picture in pictures)[True]
    rows: Rows = [
        ("pictures", f"{len(outcome.shots)} of {asked.resolution} x {asked.resolution}"),
        ("files", f"{len(pictures)}, of which {kept} were there already"),
    ]
    floors = [
        float(picture.facts["noise_floor_db"])
        for picture in pictures
        if "noise_floor_db" in picture.facts
    ]
    agreements = [shot.psnr_log_db for shot in outcome.shots if shot.psnr_log_db is not None]
    rows += _spread("noise floor", floors) + _spread("agreement", agreements)
    rows += _flicker([shot.flicker for shot in outcome.shots if shot.flicker is not None])
    rows.append(("wall time", f"{seconds:.1f} s"))
    print_rows("Rendered", rows)
    look = outcome.place.video or outcome.place.folder
    console.print(
        f"\nLook at {look}; measure with the pictures in {outcome.place.folder}", style="bold"
    )


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
