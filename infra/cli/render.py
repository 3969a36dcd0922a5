"""`trilight render`: one picture of one scene."""

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from infra.cli.console import console, print_json, print_rows, progress_bars
from pipeline.renders.settings import PASS_SPP, RenderSettings
from pipeline.renders.variant import Variant, choose_variant
from storage.errors import TrilightError

if TYPE_CHECKING:
    from pipeline.flows.render_scene import Picture
    from pipeline.renders.renderer import Sampling

_FIRST_SPP = 2 * PASS_SPP[1]
"""Fewer samples, and the noise floor may flatter (pipeline.renders.noise_floor)."""


def render(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SRC",
            help="scene .usda .usdc .usdz .usd, RenderFormer .json or .h5, .safetensors, or "
            "SHARD.tar::KEY",
        ),
    ],
    out: Annotated[Path, typer.Option(help="the picture, X.exr; X.png is written beside it")],
    engine: Annotated[str, typer.Option(help="mitsuba")] = "mitsuba",
    resolution: Annotated[int, typer.Option(help="picture width in pixels")] = 512,
    noise_floor: Annotated[
        float, typer.Option("--noise-floor", help="target in dB (psnr_log_db)")
    ] = 40.0,
    max_spp: Annotated[int, typer.Option(help="most samples per pixel")] = 4096,
    view: Annotated[int, typer.Option(help="which camera of the scene, from 0")] = 0,
    seed: Annotated[int, typer.Option(help="seed of the samples")] = 0,
    threads: Annotated[
        int | None, typer.Option(help="processor threads, all cores by default")
    ] = None,
    json: Annotated[bool, typer.Option(help="print the outcome as JSON")] = False,
) -> None:
    """Path-trace one view of a scene to a noise floor that is measured, not promised."""
    from pipeline.flows.render_scene import picture_files, render_scene
    from pipeline.flows.scene_source import scene_source

    _require(engine == "mitsuba", "--engine", engine, "mitsuba, the only one so far")
    _require(seed >= 0, "--seed", seed, "an integer from 0")
    _require(threads is None or threads > 0, "--threads", threads, "at least 1")
    settings = RenderSettings(
        resolution=resolution,
        noise_floor_db=noise_floor,
        min_spp=min(_FIRST_SPP, max_spp),
        max_spp=max_spp,
        min_mean_radiance=0.0,  # who asks for a dark picture gets it
    )
    wanted, files = scene_source(source), picture_files(out)
    variant = choose_variant()
    started = time.monotonic()
    with progress_bars() as bars:
        task = bars.add_task("samples", total=None, note="", visible=not json)

        def show(now: "Sampling") -> None:
            floor = "" if now.noise_floor_db is None else f"floor {now.noise_floor_db:.1f} dB"
            bars.update(task, completed=now.spp, total=now.expected_spp, note=floor)

        picture = render_scene(
            wanted,
            files,
            settings,
            view=view,
            seed=seed,
            variant=variant,
            threads=threads or os.cpu_count() or 1,
            sampled=show,
        )
    notes = _notes(picture, settings, variant)
    seconds = time.monotonic() - started
    if json:
        print_json(_as_json(picture, source, settings, view, notes, seconds))
    else:
        _print(picture, source, settings, view, notes, seconds)


def _require(law: bool, option: str, got: object, expected: str) -> None:
    if not law:
        raise TrilightError(f"{option} is {got}; expected {expected}.")


def _notes(picture: "Picture", settings: RenderSettings, variant: Variant) -> list[str]:
    notes = list(picture.facts.notes)
    if not picture.view.radiance_rgb.any():
        notes.append("the picture is black: the camera sees nothing that is lit")
    if picture.view.spp < _FIRST_SPP:
        notes.append(f"below {_FIRST_SPP} samples the measured noise floor may flatter")
    if variant.note:
        notes.append(f"{variant.note}; see trilight doctor")
    return notes


def _as_json(
    picture: "Picture",
    source: str,
    settings: RenderSettings,
    view: int,
    notes: list[str],
    seconds: float,
) -> dict[str, object]:
    rendered = picture.view
    return {
        "at_cap": rendered.at_cap,
        "engine": "mitsuba",
        "exr": str(picture.files.exr),
        "lights": picture.facts.num_lights,
        "noise_floor_db": round(rendered.noise_floor_db, 3),
        "noise_floor_linear_db": round(rendered.noise_floor_linear_db, 3),
        "notes": notes,
        "object_noise_floor_db": round(rendered.object_noise_floor_db, 3),
        "png": str(picture.files.png),
        "resolution": settings.resolution,
        "scene_sha256": picture.facts.digest,
        "seconds": round(seconds, 2),
        "source": source,
        "spp": rendered.spp,
        "triangles": picture.facts.num_triangles,
        "view": view,
    }


def _print(
    picture: "Picture",
    source: str,
    settings: RenderSettings,
    view: int,
    notes: list[str],
    seconds: float,
) -> None:
    rendered, facts = picture.view, picture.facts
    target = (
        f"{'the cap came before' if rendered.at_cap else 'reached'} {settings.noise_floor_db:g}"
    )
    for note in notes:
        console.print(Text(f"Note: {note}.", style="yellow"))
    rows = [
        (
            "scene",
            f"{source}, view {view}; triangles: {facts.num_triangles}, lights: {facts.num_lights}",
        ),
        ("picture", f"{settings.resolution} x {settings.resolution}, linear radiance"),
        ("samples per pixel", f"{rendered.spp}"),
        ("noise floor", f"{rendered.noise_floor_db:.1f} dB (psnr_log_db; {target} dB)"),
        ("", f"{rendered.object_noise_floor_db:.1f} dB where geometry is seen"),
        ("", f"{rendered.noise_floor_linear_db:.1f} dB linear, clamped to [0, 1]"),
        ("wall time", f"{seconds:.1f} s"),
        ("scene digest", facts.digest),
    ]
    print_rows("Rendered", rows)
    console.print(f"\nLook at {picture.files.png}; measure with {picture.files.exr}", style="bold")
