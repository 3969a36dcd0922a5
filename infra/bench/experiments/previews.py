"""What a preview costs and how far it is from the truth, by samples, filter and width.

From the results `python -m infra.setup.preview_table` makes the table that is shipped, by which
`trilight render --seconds` and `--error` choose.
"""

import functools
import time
from collections.abc import Sequence
from typing import Any

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Point, TurnFigures
from infra.bench.experiments.engines import build_within
from infra.bench.experiments.rungs import TRIANGLES, one_view_scene
from infra.bench.experiments.sampling import DB
from infra.bench.sides.preview_pictures import preview_ladder
from infra.bench.sides.rung_pictures import judged, network_rung, timed_rung
from infra.bench.workshop import Workshop
from infra.rendering.way_table import NETWORK_SCENE, NETWORK_VIEW
from pipeline.objects.generated import BENCHMARK
from pipeline.renders.preview_parts import all_parts, timed_parts
from pipeline.renders.settings import Filtered

NETWORK = "network builtin:tokens"
PROBES = ("held-out 1", "held-out 2")
"""Scenes on which other machines time the same parts (infra.bench.sides.machine_costs)."""

WIDTHS = {64: (1024, 2048), 128: (256, 512), 256: (64, 128), 512: (16, 128)}
"""By width in pixels: most samples of a preview, and samples of the references' halves together."""


def preview_name(spp: int, denoiser: Filtered) -> str:
    """Return what tables call a preview."""
    return f"{spp} sample{'s' if spp > 1 else ''}, {denoiser}"


def ladder(px: int) -> tuple[tuple[int, Filtered], ...]:
    """Return the samples and filters that are measured at a width."""
    steps = range(WIDTHS[px][0].bit_length())
    filters: tuple[Filtered, ...] = ("fast", "high")
    return tuple((1 << step, each) for step in steps for each in filters)


def _points(effort: Effort, *, px: int) -> list[Point]:
    previews = [Point(name=preview_name(*one), settings=one) for one in ladder(px)]
    return [Point(name=NETWORK), *previews]


def _measure(workshop: Workshop, points: Sequence[Point], turn: str, *, px: int) -> TurnFigures:
    renderer, child, build = workshop.kept("previews", lambda: _set_up(workshop))
    scene = child.call(one_view_scene, build, int(turn.split()[-1]))
    found, reference = child.call(preview_ladder, scene, px, ladder(px), WIDTHS[px][1])
    yield NETWORK, judged(timed_rung(network_rung(renderer, px), scene), scene, reference)
    for one, picture in zip(ladder(px), found, strict=True):
        yield preview_name(*one), judged(picture, scene, reference)


def _parts(effort: Effort) -> list[Point]:
    return [Point(name=part_name(name, px)) for px in WIDTHS for name in timed_names()]


def timed_names() -> tuple[str, ...]:
    """Return the names of all parts, those of the network too."""
    return (*all_parts(), NETWORK_SCENE, NETWORK_VIEW)


def part_name(part: str, px: int) -> str:
    """Return what tables call a part of a preview at a width."""
    return f"{part}, {px} px"


def _measure_parts(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    renderer, child, build = workshop.kept("previews", lambda: _set_up(workshop))
    scene = child.call(one_view_scene, build, int(turn.split()[-1]))
    for px in WIDTHS:
        found: dict[str, float] = child.call(timed_parts, scene, px, time.process_time)
        network = timed_rung(network_rung(renderer, px), scene)
        found[NETWORK_SCENE] = network.first_s - network.further_s
        found[NETWORK_VIEW] = network.further_s
        for part, core_s in found.items():
            yield part_name(part, px), {"core_s": core_s}


def _set_up(workshop: Workshop) -> Any:
    """Return the cheapest network that comes along, and a render child of scenes new to it."""
    import torch

    from model.neural_renderer import NeuralRenderer

    torch.set_num_threads(1)  # core-seconds of waiting threads are not the network's
    renderer = NeuralRenderer.load("builtin:tokens", device="cpu")
    workshop.note(f"{NETWORK} is {renderer.digest[:8]}")
    build = build_within(TRIANGLES)
    return renderer, workshop.render_child(build, BENCHMARK, threads=1), build


def _turns(effort: Effort) -> list[str]:
    return [f"held-out {index}" for index in range(effort.scenes)]


_SCENES = (
    f"One view each of scenes of objects of `{BENCHMARK}`, of at most {TRIANGLES} triangles; one "
    "thread, everything warm"
)


def _experiment(px: int) -> Experiment:
    return Experiment(
        name=f"previews-{px}",
        title=f"Previews by samples and filter, at {px} pixels",
        about=f"{_SCENES}.",
        covers=("render.spp", "render.denoiser", "render.seconds", "render.error_db"),
        cost=Column(name="core-seconds of a scene's first view", figure="core_s"),
        error=DB,
        better="higher",
        against="raw samples in two halves, so that neither their noise nor a denoiser is in it",
        columns=(
            Column(name="a further view, core-s", figure="view_s"),
            Column(name="least dB", figure="db", over="least"),
        ),
        also_cost=("a further view, core-s",),
        because="`--seconds` and `--error` of `trilight render` choose from this table.",
        points=functools.partial(_points, px=px),
        turns=_turns,
        measure=functools.partial(_measure, px=px),
        needs=("torch",),
    )


EXPERIMENTS = (
    *(_experiment(px) for px in WIDTHS),
    Experiment(
        name="preview-parts",
        title="What the parts of a preview cost",
        about=f"{_SCENES}: loading, passes of samples, guide pictures, filters, the network.",
        cost=Column(name="core-seconds", figure="core_s"),
        because="Any preview is priced by its parts; `trilight doctor --measure` times the same "
        "parts.",
        points=_parts,
        turns=_turns,
        measure=_measure_parts,
        needs=("torch",),
    ),
)
