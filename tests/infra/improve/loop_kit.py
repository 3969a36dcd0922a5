"""The order of a small closed loop."""

from pathlib import Path
from typing import Any

from infra.improve.order import ImproveOrder
from pipeline.making.dataset_order import DatasetOrder
from storage.settings.described import from_record

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


def loop_order(folder: Path, **given: Any) -> ImproveOrder:
    """Return two rounds of six steps over four strata."""
    plain: dict[str, Any] = {"rounds": 2, "scenes": 8, "steps": 6, "axes": ("lights", "roughness")}
    return ImproveOrder(
        **{**plain, "out": str(folder), "run": "smoke", "run_changes": TINY, **given}
    )


def strata_of_order(order: DatasetOrder) -> list[Any]:
    """Return the strata that an order states."""
    from scene_templates.strata import Stratum

    return [from_record(Stratum, record) for record in order.changes["scenes.strata"]]
