"""How often a stated noise floor is wrong: rows of distinct pictures, judged by raw references."""

import dataclasses
from collections.abc import Callable, Sequence

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Over, Point, TurnFigures, percent
from infra.bench.experiments.sampling import CORE_S
from infra.bench.sides.judged_pictures import VIEWS, Judged, judged_view
from infra.bench.workshop import Workshop
from pipeline.builds.training import smoke
from pipeline.renders.settings import USUAL_FLOOR_DB
from storage.errors import Rejected

WIDTHS = (64, 128, 256)


def _widths(effort: Effort) -> list[Point]:
    base = smoke().renders
    return [
        Point(
            name=f"{px} x {px}",
            settings=dataclasses.replace(
                base, resolution=px, noise_floor_db=USUAL_FLOOR_DB, min_mean_radiance=0.0
            ),
            default=px == base.resolution,
        )
        for px in WIDTHS
    ]


def _turns(effort: Effort) -> list[str]:
    """Return the pictures: each view has samples of its own.

    More scenes say more than more samples of one view, whose reference is half of the cost.
    """
    return [
        f"source {source} scene {scene} view {view} seed {view}"
        for scene in range(effort.judged_scenes)
        for source in range(2)
        for view in range(VIEWS)
    ]


def cluster(turn: str) -> str:
    """Return the scene of a turn: pictures of one scene are alike."""
    return turn.partition(" view ")[0]


def _measure(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    source, scene, view, seed = (int(word) for word in turn.split()[1::2])
    sources = workshop.asked.objects
    if source >= len(sources):
        raise Rejected("no_source", f"expected a --objects for source {source}")
    build = dataclasses.replace(smoke(), allowed_licences=workshop.asked.allowed_licences)
    child = workshop.kept(("judged", source), lambda: workshop.render_child(build, sources[source]))
    variants = {point.name: point.settings for point in points}
    judged = Judged(scene_index=scene, view=view, sample_seed=seed)
    yield from child.call(judged_view, judged, variants, workshop.effort.reference_spp).items()


_FIGURES: tuple[tuple[str, str, Over, Callable[[float], float] | None], ...] = (
    ("over 1 dB worse than stated, %", "over_1", "mean", percent),
    ("95 % interval from, %", "over_1", "low", percent),
    ("to, %", "over_1", "high", percent),
    ("over 3 dB, %", "over_3", "mean", percent),
    ("caution, median dB", "caution_db", "median", None),
    ("worst dB", "caution_db", "least", None),
)

_WRONG = tuple(
    Column(name=f"{metric}: {words}", figure=f"{name}_{figure}", over=over, then=then)
    for name, metric in (("log", "psnr_log_db"), ("linear", "linear"), ("object", "objects"))
    for words, figure, over, then in _FIGURES
)

EXPERIMENTS = (
    Experiment(
        name="calibration",
        title="How often a stated floor is wrong",
        about="Views of scenes of all sources of objects, rendered to "
        f"{USUAL_FLOOR_DB:g} dB or 256 samples at three widths, and held against raw references "
        "in two halves.",
        cost=CORE_S,
        columns=(
            *_WRONG,
            Column(name="samples", figure="spp", over="mean"),
            Column(name="at the cap, %", figure="at_cap", over="mean", then=percent),
            Column(name="brightness, mean %", figure="brightness", over="mean"),
            Column(name="what the reference leaves open, median dB", figure="log_open_db"),
        ),
        because="A picture is wrong where its true error is more than 1 dB (3 dB) above the stated "
        "one. Intervals are bootstrapped over scenes, since views of one scene are alike. Caution "
        "is by how much a picture is better than stated.",
        points=_widths,
        turns=_turns,
        measure=_measure,
        cluster=cluster,
    ),
)
