"""`python -m infra.bench.renders.calibration`: how often is a stated noise floor wrong?

Scenes that nothing was tuned on are rendered as a build would, to several targets, and compared
with converged pictures of other samples. A view that is more than 1 dB worse than its stated floor
is a broken promise: at most one in ten may be.
"""

import json
import os
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter, run
from rich.table import Table

from infra.bench import harness
from infra.bench.cycles.comparison import sampled
from infra.bench.render_child import smoke_child
from infra.bench.renders.ladder import render_ladder
from infra.bench.renders.named_set import NUM_SAMPLED
from infra.cli.console import console, progress_bars
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from storage.atomic import write_atomically
from storage.errors import TrilightError
from storage.metrics import psnr_linear_db, psnr_log_db
from storage.scene import Scene

TARGETS_DB = (38.0, 42.0, 46.0, 50.0)

BROKEN_DB = 1.0
"""A stated floor that is better than the truth by more than this is a broken promise."""

FIRM_DB = 6.0
"""A reference whose own floor is this much above the stated one adds 1 dB to the error at most."""

_REFERENCE_SEED = 1_000_003


@dataclass(frozen=True, kw_only=True)
class Promise:
    """One view: what was stated, and what is true."""

    scene: str
    """Name of the scene."""
    target_db: float
    """The floor that was asked for."""
    spp: int
    """Samples per pixel that were spent."""
    at_cap: bool
    """Whether it ended at the cap."""
    stated_db: float
    """The measured floor, psnr_log_db."""
    true_db: float
    """psnr_log_db to the reference."""
    stated_linear_db: float
    """The measured floor, psnr_linear_db."""
    true_linear_db: float
    """psnr_linear_db to the reference."""
    reference_db: float
    """The reference's own floor: a truth near it is soft."""


def promises(
    scene: Scene, name: str, resolution: int, max_spp: int, reference_spp: int
) -> list[Promise]:
    """Return one promise for each target; runs in a render child."""
    settings = RenderSettings(
        resolution=resolution,
        noise_floor_db=max(TARGETS_DB) + 8,
        min_spp=min(2048, reference_spp),
        max_spp=reference_spp,
        min_mean_radiance=0.0,
    )
    reference = SceneRenderer(scene, settings).render_view(
        scene.c2w[0], float(scene.fov_deg[0]), _REFERENCE_SEED
    )
    ladder = render_ladder(scene, resolution, TARGETS_DB, max_spp, seed=0)
    return [_promise(name, rung.target_db, rung.view, reference) for rung in ladder.rungs]


def _promise(name: str, target_db: float, view: RenderedView, reference: RenderedView) -> Promise:
    return Promise(
        scene=name,
        target_db=target_db,
        spp=view.spp,
        at_cap=view.at_cap,
        stated_db=view.noise_floor_db,
        true_db=psnr_log_db(view.radiance_rgb, reference.radiance_rgb),
        stated_linear_db=view.noise_floor_linear_db,
        true_linear_db=psnr_linear_db(view.radiance_rgb, reference.radiance_rgb),
        reference_db=reference.noise_floor_db,
    )


def broken(found: list[Promise]) -> list[Promise]:
    """Return the views whose stated floor is more than BROKEN_DB better than the truth."""
    return [one for one in found if one.stated_db - one.true_db > BROKEN_DB]


def with_firm_truth(found: list[Promise]) -> list[Promise]:
    """Return the views whose reference is better than what they state by FIRM_DB or more."""
    return [one for one in found if one.reference_db - one.stated_db >= FIRM_DB]


def main(
    out: Annotated[Path, Parameter(help="JSON file to write")],
    first: Annotated[int, Parameter(help="number of the first scene")] = NUM_SAMPLED,
    scenes: Annotated[int, Parameter(help="how many")] = 40,
    resolution: Annotated[int, Parameter(help="pixels each way")] = 96,
    max_spp: Annotated[int, Parameter(help="cap of what is judged")] = 1024,
    reference_spp: Annotated[int, Parameter(help="cap of the references")] = 4096,
) -> None:
    """Render held-out scenes to several targets, and count broken promises."""
    found: list[Promise] = []
    with tempfile.TemporaryDirectory() as folder, progress_bars() as bars:
        task = bars.add_task("scenes", total=scenes, note="")
        child = smoke_child(Path(folder), threads=os.cpu_count() or 1)
        try:
            for index in range(first, first + scenes):
                named = sampled(index)
                scene = named.make(child)
                arguments = (scene, named.name, resolution, max_spp, reference_spp)
                found += child.call(promises, *arguments)
                bars.advance(task)
                # after every scene: what was measured survives whatever comes next
                write_atomically(out, _record(found).encode())
        finally:
            child.close()
    console.print(_table(found))


def _record(found: list[Promise]) -> str:
    record = {"machine": harness.machine(), "views": [asdict(one) for one in found]}
    return json.dumps(record) + "\n"


def _table(found: list[Promise]) -> Table:
    table = Table(box=None)
    for title in ("target", "views", "broken", "median spp", "at cap", "truth - stated, median"):
        table.add_column(title, justify="right")
    for target_db in TARGETS_DB:
        chosen = [one for one in found if one.target_db == target_db]
        table.add_row(f"{target_db:g} dB", *_cells(chosen))
    table.add_row("all", *_cells(found))
    table.add_row("firm truth", *_cells(with_firm_truth(found)))
    return table


def _cells(chosen: list[Promise]) -> list[str]:
    if not chosen:
        return ["0"]
    return [
        str(len(chosen)),
        f"{100 * len(broken(chosen)) / len(chosen):.0f} %",
        f"{np.median([one.spp for one in chosen]):.0f}",
        f"{100 * np.mean([one.at_cap for one in chosen]):.0f} %",
        f"{np.median([one.true_db - one.stated_db for one in chosen]):.1f} dB",
    ]


if __name__ == "__main__":
    try:
        run(main)
    except TrilightError as mistake:
        sys.exit(f"infra.bench.renders.calibration: {mistake}")
