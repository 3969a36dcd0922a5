"""A closed loop whose scenes are toys made in milliseconds; training and judging are real."""

from pathlib import Path
from typing import Any

import torch

from infra.improve.order import ImproveOrder
from infra.improve.rounds import LoopWorkers
from infra.train_order import TrainOrder
from pipeline.making.dataset_order import DatasetOrder
from scene_templates.strata import stratum_of
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.scene_logs import log_scene
from storage.records.scene import Scene
from storage.settings.described import from_record
from tests.train.toy import toy_scene, write_toy_dataset
from train.loop.crew import Crew
from train.progress import TrainProgress
from train.run import train_run

TINY = {
    "resolution": 16,
    "model.width": 36,
    "model.hidden_width": 48,
    "model.rope_num_freqs": 1,
    "model.encoder_layers": 1,
    "model.decoder_layers": 1,
    "views_per_scene": 2,
    "scenes_per_step": 2,
    "log_every": 1,
    "validate_every": 6,
    "checkpoint_every": 2,
    "learning_rate": 1e-4,
}
"""Changes to the run smoke."""


class Killed(Exception):
    """The power failed."""


def loop_order(folder: Path, **given: Any) -> ImproveOrder:
    """Return two rounds of six steps over four strata."""
    plain: dict[str, Any] = {"rounds": 2, "scenes": 8, "steps": 6, "axes": ("lights", "roughness")}
    return ImproveOrder(
        **{**plain, "out": str(folder), "run": "smoke", "run_changes": TINY, **given}
    )


def toys(order: DatasetOrder) -> Dataset:
    """Write the dataset of an order with toys for scenes, as often as it is asked."""
    from pipeline.builds.named import named_build

    settings = named_build(order.build, seed=order.seed, changes=order.changes).scenes
    first = order.scenes == 6 * order.changes["splits.scenes_per_shard"]
    train, seed = (order.scenes or 0) * 2 // 3 if first else (order.scenes or 0), order.seed or 0

    def scene_of(index: int) -> Scene:
        scene = toy_scene(100 * seed + index)
        stratum = stratum_of(settings.strata, index).name
        return scene.with_provenance({**scene.provenance, "stratum": stratum})

    place = Path(order.place)
    is_new = not (place / "manifest.json").exists()
    write_toy_dataset(
        place, train=train, validation=8 if first else 0, scene_of=scene_of, resolution=16
    )
    for index in range(train if is_new else 0):
        cost = 2.0 if "many_lights" in stratum_of(settings.strata, index).name else 1.0
        log_scene(DatasetFolder(place), "toys", index, seconds=cost, cores=1, num_rejected=0)
    return open_dataset(str(place))


class Kill(TrainProgress):
    """Ends a training when a step is done."""

    def __init__(self, step: int | None) -> None:
        self._step = step

    def advance(self, *, step: int, loss: float, learning_rate: float, views_per_s: float) -> None:
        if step == self._step:
            raise Killed


def workers(killed_at: str | None = None, *, step: int | None = None) -> LoopWorkers:
    """Return who makes and trains, killed where "ROUND WHAT" begins, or when a step is done."""

    def train(order: TrainOrder) -> float:
        torch.manual_seed(0)
        train_run(
            order.settings(),
            data=list(order.data),
            out=Path(order.place),
            start=order.start(),
            workers=0,
            crew=Crew(device=torch.device("cpu")),
            progress=Kill(step),
        )
        return 1.0

    def begins(number: int, what: str) -> None:
        if f"{number} {what}" == killed_at:
            raise Killed

    return LoopWorkers(make=toys, train=train, begins=begins)


def strata_of_order(order: DatasetOrder) -> list[Any]:
    """Return the strata that an order states."""
    from scene_templates.strata import Stratum

    return [from_record(Stratum, record) for record in order.changes["scenes.strata"]]
