"""Every knob that has a curve, in the order of the page."""

from infra.bench.trade import (
    detail_knob,
    engine_knob,
    mesh_knobs,
    network_knobs,
    path_knobs,
    picture_knobs,
    pipeline_knob,
    render_knobs,
    stored_knobs,
)
from infra.bench.trade.curves import Knob
from storage.errors import TrilightError

KNOBS: tuple[Knob, ...] = (
    *render_knobs.KNOBS,
    *path_knobs.KNOBS,
    *mesh_knobs.KNOBS,
    *detail_knob.KNOBS,
    *stored_knobs.KNOBS,
    *picture_knobs.KNOBS,
    *network_knobs.KNOBS,
    *engine_knob.KNOBS,
    *pipeline_knob.KNOBS,
)


def knob_named(name: str) -> Knob:
    """Return a knob; raises TrilightError for an unknown name."""
    for knob in KNOBS:
        if knob.name == name:
            return knob
    names = ", ".join(knob.name for knob in KNOBS)
    raise TrilightError(f"--knob {name!r}: unknown; expected one of {names}.")
