"""What a render child takes of a catalogue of any size: memory, opening, a draw of a scene."""

from pathlib import Path

from infra.bench.experiment import Column, Experiment, Figures, Point, one_by_one, repeats
from infra.bench.subjects.many_objects import NUM_REAL, draw_in_child, write_catalogue
from infra.bench.workshop import Workshop
from pipeline.assets.settings import AssetSettings
from pipeline.making.object_batches import prepared_object
from pipeline.making.prepare_isolated import asset_store, prepare_isolated

COUNTS = (10, 1_000, 100_000, 1_000_000)
_SCENES = 300


def _drawn(workshop: Workshop, point: Point, turn: str) -> Figures:
    def written() -> Path:
        folder = workshop.folder()
        prepared, _ = prepare_isolated(
            workshop.objects[:NUM_REAL], AssetSettings(), workers=1, done=lambda: None
        )
        known = [prepared_object(asset) for asset in prepared]
        assets = [(one.asset_name, one.asset_sha256, one.least_triangles) for one in known]
        write_catalogue(folder, assets, point.settings)
        return folder

    folder = workshop.kept(("many objects", point.name), written)
    return draw_in_child(folder, asset_store().root, _SCENES)


def _mega(value: float) -> float:
    return value / 1e6


def _milli(value: float) -> float:
    return 1000 * value


EXPERIMENTS = (
    Experiment(
        name="many-objects",
        title="A render child by objects of the dataset",
        about=(
            f"A lock and index of so many objects over {NUM_REAL} real assets, opened in a fresh "
            f"process that draws and opens three objects for each of {_SCENES} scenes."
        ),
        cost=Column(name="MB held at most", figure="held_bytes", then=_mega),
        columns=(
            Column(name="ms to open", figure="open_s", then=_milli),
            Column(name="core-ms a scene, all objects fit", figure="draw_s", then=_milli),
            Column(name="core-ms a scene, some do not", figure="tight_s", then=_milli),
        ),
        points=lambda effort: [
            Point(name=f"{count:,} objects", settings=count) for count in COUNTS
        ],
        turns=repeats,
        measure=one_by_one(_drawn),
    ),
)
