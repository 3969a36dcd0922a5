"""`trilight render`: pictures of scenes, by path tracing, by a trained network, or by both."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress

from infra.cli.console import progress_bars

if TYPE_CHECKING:
    from pipeline.renders.renderer import Sampling


def render(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SRC",
            help="scene .usda .usdc .usdz .usd, RenderFormer .json or .h5, .safetensors, or "
            "SHARD.tar::KEY; for many pictures also a shard, a folder of scenes, or "
            "'NAME{000..119}.json'",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="X.exr for one picture (X.png is written beside it for looking, enlarged below "
            "256 pixels); a folder, X.mp4 or X.webp for many: numbered, and kept where they are "
            "there already"
        ),
    ],
    engine: Annotated[str, typer.Option(help="mitsuba, neural, or both side by side")] = "mitsuba",
    checkpoint: Annotated[
        str | None,
        typer.Option(help="neural: model.safetensors of a run [the small network shipped here]"),
    ] = None,
    resolution: Annotated[
        int | None,
        typer.Option(help="picture width in pixels [512; neural: what the network was trained on]"),
    ] = None,
    noise_floor: Annotated[
        float, typer.Option("--noise-floor", help="mitsuba: target in dB (psnr_log_db)")
    ] = 40.0,
    max_spp: Annotated[int, typer.Option(help="mitsuba: most samples per pixel")] = 4096,
    view: Annotated[int, typer.Option(help="which camera of the scene, from 0")] = 0,
    orbit: Annotated[
        int | None, typer.Option(help="so many pictures on a circle around what the camera sees")
    ] = None,
    arc: Annotated[
        float, typer.Option(help="degrees of that circle; below 360 the camera is its middle")
    ] = 360.0,
    cameras: Annotated[
        str | None, typer.Option(help="a picture from each camera of this .json or scene")
    ] = None,
    fps: Annotated[int, typer.Option(help="pictures a second of a video")] = 24,
    tone_map: Annotated[
        str, typer.Option(help="of PNG and video: plain, or filmic (ACES 2.0)")
    ] = "plain",
    exposure: Annotated[
        float,
        typer.Option(
            metavar="EV",
            help="stops by which PNG and video are brightened, or darkened below 0: each doubles "
            "the light; EXR keeps radiance as it is",
        ),
    ] = 0.0,
    precision: Annotated[
        str, typer.Option(help="neural: float32, bfloat16; on CUDA also tf32, float16")
    ] = "float32",
    lights_per_pass: Annotated[
        int, typer.Option(help="neural: most emitting triangles at once; groups are added up")
    ] = 8,
    skip_empty_bundles: Annotated[
        bool, typer.Option(help="neural: leave black what no triangle reaches; faster, less exact")
    ] = False,
    albedo_over_one: Annotated[
        str, typer.Option(help="RenderFormer scenes with diffuse + specular above 1: scale, refuse")
    ] = "scale",
    seed: Annotated[int, typer.Option(help="mitsuba: seed of the samples")] = 0,
    threads: Annotated[
        int | None, typer.Option(help="processor threads, all cores by default")
    ] = None,
    json: Annotated[bool, typer.Option(help="print the outcome as JSON")] = False,
) -> None:
    """Render scenes: path traced to a measured noise floor, or by a trained network."""
    from infra.cli.rendered import print_outcome
    from infra.rendering.session import Asked, render_asked
    from pipeline.scenes.described_albedos import require_choice

    asked = Asked(
        source=source,
        out=out,
        engine=engine,
        checkpoint=checkpoint,
        resolution=resolution,
        noise_floor_db=noise_floor,
        max_spp=max_spp,
        view=view,
        orbit=orbit,
        arc_deg=arc,
        cameras=cameras,
        fps=fps,
        tone_map=tone_map,
        exposure_ev=exposure,
        precision=precision,
        lights_per_pass=lights_per_pass,
        skip_empty_bundles=skip_empty_bundles,
        albedo_over_one=require_choice(albedo_over_one),
        seed=seed,
        threads=threads,
    )
    started = time.monotonic()
    with progress_bars() as bars:
        outcome = render_asked(asked, _Bars(bars, visible=not json))
    print_outcome(outcome, time.monotonic() - started, as_json=json)


class _Bars:
    """Shows how many pictures are finished, and how many samples the one at hand has."""

    def __init__(self, bars: Progress, *, visible: bool) -> None:
        self._bars = bars
        self._pictures = bars.add_task("pictures", total=None, note="", visible=False)
        self._samples = bars.add_task("samples", total=None, note="", visible=False)
        self._visible = visible

    def pictures(self, done: int, total: int) -> None:
        self._bars.update(self._pictures, completed=done, total=total, visible=self._visible)

    def sampled(self, now: "Sampling") -> None:
        floor = "" if now.noise_floor_db is None else f"floor {now.noise_floor_db:.1f} dB"
        self._bars.update(
            self._samples,
            completed=now.spp,
            total=now.expected_spp,
            note=floor,
            visible=self._visible,
        )
