"""`python -m infra.bench.renders.rising_floors`: what each noise floor looks like and costs.

One scene of built-in objects at rising targets, each with its error and its price beneath.
"""

import dataclasses
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib
import numpy as np
from cyclopts import Parameter, run
from numpy.typing import NDArray

from infra.bench.cycles.comparison import sampled
from infra.bench.harness import RESULTS
from infra.bench.render_child import smoke_child
from infra.cli.console import console
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from storage.conventions import preview_srgb8
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.scene import Scene

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

TARGETS_DB = (38.0, 40.0, 42.0, 44.0, 46.0)
_REFERENCE_SEED = 1_000_003
_MOST_ERROR = 0.1
"""The brightest of the error pictures: a difference of 0.1 in log10(1 + radiance), 26 %."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Rendered:
    view: RenderedView
    core_s: float


def rendered_to_targets(scene: Scene, settings: RenderSettings) -> list[_Rendered]:
    """Return the view at each target, and last the reference; runs in a render child."""
    _render(scene, dataclasses.replace(settings, max_spp=settings.min_spp), seed=0)  # compiles
    views = [
        _render(scene, dataclasses.replace(settings, noise_floor_db=target_db), seed=1)
        for target_db in TARGETS_DB
    ]
    return [*views, _render(scene, settings, _REFERENCE_SEED)]


def _render(scene: Scene, settings: RenderSettings, seed: int) -> _Rendered:
    renderer = SceneRenderer(scene, settings)
    started = time.process_time()
    view = renderer.render_view(scene.c2w[0], float(scene.fov_deg[0]), seed)
    return _Rendered(view=view, core_s=time.process_time() - started)


def main(
    out: Annotated[Path, Parameter(help="PNG file")] = RESULTS / "rising-floors.png",
    scene: Annotated[int, Parameter(help="which of the sampled scenes")] = 12,
    resolution: Annotated[int, Parameter(help="pixels each way")] = 256,
    max_spp: Annotated[int, Parameter(help="cap, and samples of the reference")] = 2048,
) -> None:
    """Draw one scene at rising noise floors, with its cost under each."""
    settings = RenderSettings(
        resolution=resolution, noise_floor_db=60.0, min_spp=32, max_spp=max_spp
    )
    with tempfile.TemporaryDirectory() as folder:
        child = smoke_child(Path(folder), threads=os.cpu_count() or 1)
        try:
            made = child.call(rendered_to_targets, sampled(scene).make(child), settings)
        finally:
            child.close()
    _draw(made[:-1], made[-1].view.radiance_rgb, out)
    console.print(f"written: {out}")


def _draw(made: list[_Rendered], reference: NDArray[np.float32], out: Path) -> None:
    figure, rows = plt.subplots(
        2, len(made), figsize=(2.6 * len(made), 6.2), layout="constrained", squeeze=False
    )
    for target_db, one, picture, error in zip(TARGETS_DB, made, *rows, strict=True):
        radiance_rgb = one.view.radiance_rgb
        true_db = psnr_log_db(radiance_rgb, reference)
        picture.imshow(preview_srgb8(radiance_rgb))
        picture.set_title(f"target {target_db:.0f} dB\nstated {one.view.noise_floor_db:.1f} dB")
        shown = error.imshow(
            np.abs(np.log10(1 + radiance_rgb) - np.log10(1 + reference)).mean(axis=-1),
            vmin=0,
            vmax=_MOST_ERROR,
            cmap="magma",
        )
        error.set_title(
            f"true {true_db:.1f} dB\n{one.view.spp} samples, {one.core_s:.1f} core-s", fontsize=10
        )
        for axes in (picture, error):
            axes.set_axis_off()
    figure.colorbar(
        shown,
        ax=rows[1].tolist(),
        label="mean |difference| of log10(1 + radiance)",
        location="bottom",
        shrink=0.4,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    try:
        run(main)
    except TrilightError as mistake:
        sys.exit(f"infra.bench.renders.rising_floors: {mistake}")
