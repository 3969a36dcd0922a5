"""`python -m infra.bench.cycles.residual`: what is left between our pictures and those of Cycles.

Both renderers make each view twice, with other samples. What the two of one renderer disagree on is
its noise, and half of that mean square counts against each picture; what the pictures of the two
renderers disagree on beyond both is systematic: light transport, shading, or the denoisers' bias.
Squares are of linear radiance clamped to [0, 1], as in psnr_linear_db.
"""

import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import matplotlib
import numpy as np
from cyclopts import Parameter, run
from numpy.typing import NDArray
from rich.table import Table

from infra.bench.cycles.comparison import NamedScene, described, sampled
from infra.bench.cycles.cycles_picture import Request, cycles_picture
from infra.bench.harness import RESULTS
from infra.bench.render_child import smoke_child
from infra.cli.console import console, progress_bars
from pipeline.isolation import IsolatedChild
from pipeline.renders.renderer import RenderedView, SceneRenderer
from pipeline.renders.settings import RenderSettings
from storage.conventions import preview_srgb8
from storage.errors import TrilightError
from storage.metrics import MAX_DB
from storage.scene import Scene

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

_SEEDS = (1, 2)
_BLOCK_PX = 8
_MOST_ERROR = 0.05
"""The brightest of the error pictures, in clamped linear radiance."""

_WORST_SHARE = 0.01
"""Of the pixels: how much of the residual they hold tells glints and caustics from shading."""

Pair = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True, kw_only=True)
class Account:
    """Where the mean square between the two renderers comes from; each part as -10 log10, dB."""

    between_db: float
    """Our first picture against Cycles' first: psnr_linear_db."""
    cycles_noise_db: float
    """Half the mean square between Cycles' two pictures."""
    our_noise_db: float
    """Half the mean square between our two."""
    rest_db: float
    """What of `between` neither noise explains; MAX_DB where nothing is left."""
    rest_blocks_db: float
    """The same of means of 8 x 8 pixels, where noise and edges are averaged away."""
    worst_share: float
    """Share of the mean square that the worst hundredth of the pixels holds."""
    mean_ratio: float
    """Our mean clamped radiance by Cycles'."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """One view by both renderers."""

    name: str
    """Of the scene."""
    ours: Pair
    """By our renderer."""
    cycles: Pair
    """By Cycles."""


def account(ours: Pair, cycles: Pair) -> Account:
    """Divide the difference of two renderers into the noise of each and what is left.

    Args:
        ours: two pictures [R, R, 3] of linear radiance that share no sample.
        cycles: likewise; R is a multiple of 8.

    It cannot tell a bias that both pictures of one renderer share, such as its denoiser's, from
    other light transport: both are in the rest.
    """
    clamped = [np.clip(one.astype(np.float64), 0.0, 1.0) for one in (*ours, *cycles)]
    square = (clamped[0] - clamped[2]) ** 2
    between, our_noise, cycles_noise = _parts(clamped)
    blocks = _parts([_block_means(one) for one in clamped])
    by_pixel = np.sort(square.mean(axis=-1), axis=None)[::-1]
    worst = by_pixel[: max(1, round(_WORST_SHARE * by_pixel.size))]
    return Account(
        between_db=_db(between),
        cycles_noise_db=_db(cycles_noise),
        our_noise_db=_db(our_noise),
        rest_db=_db(between - our_noise - cycles_noise),
        rest_blocks_db=_db(blocks[0] - blocks[1] - blocks[2]),
        worst_share=float(worst.sum() / max(by_pixel.sum(), np.finfo(np.float64).tiny)),
        mean_ratio=float(clamped[0].mean() / clamped[2].mean()),
    )


def _parts(pictures: list[NDArray[np.float64]]) -> tuple[float, float, float]:
    """Return the mean squares between the renderers, of our noise and of Cycles' noise.

    The first is the mean over all four pairs of pictures: one pair would add its chance to it.
    """
    first, second, third, fourth = pictures
    pairs = [(one, other) for one in (first, second) for other in (third, fourth)]
    between = float(np.mean([((one - other) ** 2).mean() for one, other in pairs]))
    return between, ((first - second) ** 2).mean() / 2, ((third - fourth) ** 2).mean() / 2


def _block_means(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    blocks = picture.shape[0] // _BLOCK_PX
    return picture.reshape(blocks, _BLOCK_PX, blocks, _BLOCK_PX, 3).mean(axis=(1, 3))


def _db(mean_square: float) -> float:
    return float(np.clip(-10 * np.log10(max(mean_square, 10 ** (-MAX_DB / 10))), 0, MAX_DB))


def rendered_twice(scene: Scene, resolution: int, spp: int) -> Pair:
    """Return the first view with each seed; runs in a render child."""
    settings = RenderSettings(
        resolution=resolution,
        noise_floor_db=MAX_DB - 1,
        min_spp=spp,
        max_spp=spp,
        min_mean_radiance=0.0,
    )
    views: list[RenderedView] = [
        SceneRenderer(scene, settings).render_view(scene.c2w[0], float(scene.fov_deg[0]), seed)
        for seed in _SEEDS
    ]
    return views[0].radiance_rgb, views[1].radiance_rgb


def _by_cycles(scene: Scene, resolution: int, spp: int, threads: int) -> Pair:
    first, second = (
        cycles_picture(
            scene,
            0,
            Request(resolution=resolution, spp=spp, denoise=True, seed=seed, threads=threads),
        ).radiance_rgb
        for seed in _SEEDS
    )
    return first, second


def main(
    out: Annotated[Path, Parameter(help="PNG file")] = RESULTS / "cycles-residual.png",
    scenes: Annotated[
        Path | None,
        Parameter(help="folder of RenderFormer scene files: figures only [none]"),
    ] = None,
    scene: Annotated[list[str] | None, Parameter(help="name in it; may be repeated")] = None,
    sampled_scene: Annotated[
        list[int] | None,
        Parameter(help="scene of built-in objects; may be repeated [0, 4, 12]"),
    ] = None,
    resolution: Annotated[int, Parameter(help="pixels each way")] = 256,
    spp: Annotated[int, Parameter(help="samples of every picture")] = 1024,
) -> None:
    """Render every view four times, and say where the difference comes from."""
    chosen = [described(scenes.resolve(), f"{name}.json") for name in scene or ()] if scenes else []
    chosen += [sampled(index) for index in sampled_scene or (0, 4, 12)]
    threads = os.cpu_count() or 1
    made: list[Pictures] = []
    with tempfile.TemporaryDirectory() as folder, progress_bars() as bars:
        task = bars.add_task("scenes", total=len(chosen), note="")
        child = smoke_child(Path(folder), threads=threads)
        try:
            for named in chosen:
                bars.update(task, note=named.name)
                made.append(_pictures(named, child, resolution, spp, threads))
                bars.advance(task)
        finally:
            child.close()
    console.print(_table(made))
    draw([one for one, named in zip(made, chosen, strict=True) if named.publishable], out)
    console.print(f"written: {out}")


def _pictures(
    named: NamedScene, child: IsolatedChild, resolution: int, spp: int, threads: int
) -> Pictures:
    made = named.make(child)
    return Pictures(
        name=named.name,
        ours=child.call(rendered_twice, made, resolution, spp),
        cycles=_by_cycles(made, resolution, spp, threads),
    )


def _table(made: list[Pictures]) -> Table:
    table = Table(box=None)
    table.add_column("scene", no_wrap=True)
    titles = ("between", "Cycles", "ours", "rest", "blocks", "worst 1 %", "mean ratio")
    for title in titles:
        table.add_column(title, justify="right", no_wrap=True)
    for one in made:
        found = account(one.ours, one.cycles)
        parts = (
            found.between_db,
            found.cycles_noise_db,
            found.our_noise_db,
            found.rest_db,
            found.rest_blocks_db,
        )
        shown = [f"{part:.1f}" for part in parts]
        table.add_row(one.name, *shown, f"{found.worst_share:.0%}", f"{found.mean_ratio:.4f}")
    return table


def draw(made: list[Pictures], out: Path) -> None:
    """Draw ours, Cycles', their difference, and Cycles' with itself, a row a view."""
    figure, rows = plt.subplots(
        len(made), 4, figsize=(11, 2.9 * len(made)), layout="constrained", squeeze=False
    )
    for one, axes in zip(made, rows, strict=True):
        (ours, _), (theirs, again) = one.ours, one.cycles
        axes[0].imshow(preview_srgb8(ours))
        axes[1].imshow(preview_srgb8(theirs))
        for column, (left, right) in ((2, (ours, theirs)), (3, (theirs, again))):
            difference = np.abs(np.clip(left, 0, 1) - np.clip(right, 0, 1)).mean(axis=-1)
            shown = axes[column].imshow(difference, vmin=0, vmax=_MOST_ERROR, cmap="magma")
        found = account(one.ours, one.cycles)
        titles = (
            f"{one.name}: ours",
            "Cycles",
            f"difference, {found.between_db:.1f} dB",
            f"Cycles, another seed, {found.cycles_noise_db - 10 * np.log10(2):.1f} dB",
        )
        for panel, title in zip(axes, titles, strict=True):
            panel.set_title(title, fontsize=10)
            panel.set_axis_off()
    figure.colorbar(
        shown,
        ax=rows.ravel().tolist(),
        label="mean |difference|, radiance clamped to [0, 1]",
        shrink=0.6,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    try:
        run(main)
    except TrilightError as mistake:
        sys.exit(f"infra.bench.cycles.residual: {mistake}")
