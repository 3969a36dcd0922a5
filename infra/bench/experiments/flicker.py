"""How films flicker by each rung, and what a frame of them costs."""

import functools
from collections.abc import Mapping, Sequence

import numpy as np

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.experiments.rungs import (
    LAMPS,
    PHYSICS,
    kind_of,
    means,
    network_points,
    one_view_scene,
    rival,
    samples_name,
)
from infra.bench.sides.judged_pictures import Reference, true_error_db
from infra.bench.sides.kept_references import kept_reference
from infra.bench.sides.orbits import Film, film, sampled_films, true_flicker_db, with_orbit
from infra.bench.workshop import Workshop
from pipeline.objects.generated import BENCHMARK
from pipeline.renders.camera import Camera
from pipeline.renders.settings import Filtered
from storage.conventions import log10_radiance

FRAMES, ARC_DEG = 24, 24.0
"""Frames of an orbit, and its angle in degrees: a slow turn of a second."""

SAMPLES: Mapping[str, tuple[int, Filtered, bool]] = {
    samples_name((1, "fast")): (1, "fast", False),
    samples_name((4, "fast")): (4, "fast", False),
    f"{samples_name((4, 'fast'))}, new noise": (4, "fast", True),
    samples_name((16, "fast")): (16, "fast", False),
    samples_name((16, "high")): (16, "high", False),
}
"""Samples a pixel, the filter, and whether each frame has noise of its own."""


def _points(effort: Effort) -> list[Point]:
    traced = [Point(name=name) for name in (LAMPS, PHYSICS)]
    return [*traced, *(Point(name=name, settings=SAMPLES[name]) for name in SAMPLES)]


def _turns(effort: Effort) -> list[str]:
    """Return a third of the scenes that one view is judged of: an orbit is as dear as 24."""
    return [f"orbit of held-out {index}" for index in range(max(2, effort.scenes // 3))]


def _measure(workshop: Workshop, points: Sequence[Point], turn: str, *, px: int) -> TurnFigures:
    rungs, child, build = means(workshop, px)
    scene = child.call(one_view_scene, build, int(turn.split()[-1]))
    scene = with_orbit(scene, FRAMES, ARC_DEG)
    references = [
        kept_reference(
            child,
            scene,
            Camera(c2w=c2w.astype(np.float64), fov_deg=float(fov_deg), resolution=px),
            workshop.effort.max_spp,
        )
        for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True)
    ]
    for point in points:
        if point.name in rungs:
            yield point.name, _judged(film(rungs[point.name], scene), references)
    shown = child.call(sampled_films, scene, px, list(SAMPLES.values()))
    for name, one in zip(SAMPLES, shown, strict=True):
        yield name, _judged(one, references)


def _judged(one: Film, references: Sequence[Reference]) -> Mapping[str, float]:
    flicker_db, open_db = true_flicker_db(one.frames_rgb, references)
    everywhere = np.ones(one.frames_rgb.shape[1:3], bool)
    errors_db = [
        true_error_db(frame, reference, log10_radiance, everywhere)[0]
        for frame, reference in zip(one.frames_rgb, references, strict=True)
    ]
    return {
        "view_s": one.view_s,
        "flicker_db": flicker_db,
        "open_db": open_db,
        "db": float(np.median(errors_db)),
    }


def _experiment(px: int) -> Experiment:
    return Experiment(
        name=f"flicker-{px}",
        title=f"What flickers in a film of {px} pixels",
        about=f"Orbits of {FRAMES} frames over {ARC_DEG:.0f} degrees around scenes of objects of "
        f"`{BENCHMARK}`, by the cameras of `trilight render --orbit`; one thread, everything warm. "
        "Noise stays where it is on the picture from frame to frame, as that command leaves it, "
        "but where the row says otherwise.",
        cost=Column(name="a further view, core-s", figure="view_s"),
        error=Column(name="flicker, dB", figure="flicker_db"),
        better="higher",
        against="raw samples in two halves: the mean square by which the error of log10(1 + "
        "radiance) changes from one frame to the next, as a PSNR of peak 1, without their noise",
        columns=(
            Column(name="worst scene, dB", figure="flicker_db", over="least"),
            Column(name="more than the first network, dB", figure="flicker_db", over="pair"),
            Column(name="error of a frame, dB", figure="db"),
            Column(name="left open by the references, dB", figure="open_db", over="most"),
        ),
        because="An error that stays where it is on the screen is hardly seen in motion: errors "
        "that have nothing to do with each other from frame to frame flicker 3 dB worse than they "
        "err, and what flickers less than 3 dB below its error is calmer than that.",
        points=_points,
        asked_points=network_points,
        rival=rival,
        kind=kind_of,
        turns=_turns,
        measure=functools.partial(_measure, px=px),
        needs=("torch",),
    )


EXPERIMENTS = (_experiment(64),)
