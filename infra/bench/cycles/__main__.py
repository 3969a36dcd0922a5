"""`python -m infra.bench.cycles`: our renderer beside Blender's Cycles, as a table and as JSON.

The first run installs Blender (380 MB) into the user's cache.
"""

import dataclasses
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter, run
from rich.table import Table

from infra.bench import harness
from infra.bench.cycles import comparison, environment
from infra.bench.cycles.comparison import NamedScene, Plan, SceneResult
from infra.bench.render_child import smoke_child
from infra.cli.console import console, progress_bars
from storage.atomic import write_atomically
from storage.errors import TrilightError


def main(
    out: Annotated[Path, Parameter(help="JSON file to write")],
    scenes: Annotated[
        Path | None, Parameter(help="folder of RenderFormer scene files [none]")
    ] = None,
    scene: Annotated[
        list[str] | None, Parameter(help="name in that folder; may be repeated [all]")
    ] = None,
    sampled: Annotated[int, Parameter(help="scenes composed of built-in objects")] = 3,
    resolution: Annotated[int, Parameter(help="pixels each way")] = 128,
    cycles_spp: Annotated[str, Parameter(help="samples of Cycles")] = "128,1024",
    our_spp: Annotated[str, Parameter(help="our samples, multiples of 128")] = "128,1024",
    reference_spp: Annotated[int, Parameter(help="our samples of the reference")] = 8192,
    threads: Annotated[int, Parameter(help="of either renderer")] = os.cpu_count() or 1,
) -> None:
    """Render the same views with both, and print seconds and errors."""
    chosen = _chosen(scenes, scene or [], sampled)
    plan = Plan(
        resolution=resolution,
        cycles_spp=_numbers(cycles_spp, 1),
        our_spp=_numbers(our_spp, 128),
        reference_spp=_numbers(str(reference_spp), 128)[0],
        threads=threads,
    )
    environment.blender_python()
    results: list[SceneResult] = []
    with tempfile.TemporaryDirectory() as folder, progress_bars() as bars:
        task = bars.add_task("pictures", total=len(chosen) * comparison.num_pictures(plan), note="")
        child = smoke_child(Path(folder), threads=threads)
        try:
            for named in chosen:
                bars.update(task, note=named.name)
                results.append(
                    comparison.compare_scene(named, plan, child, lambda: bars.advance(task))
                )
                # after every scene: what was measured survives whatever comes next
                write_atomically(out, (json.dumps(_record(plan, results)) + "\n").encode())
        finally:
            child.close()
    console.print(_table(results))
    console.print(_summary(plan, results))


def _chosen(folder: Path | None, names: list[str], num_sampled: int) -> list[NamedScene]:
    if folder is None:
        described = []
    else:
        root = folder.resolve()
        files = [f"{name}.json" for name in names] or sorted(p.name for p in root.glob("*.json"))
        missing = [name for name in files if not (root / name).is_file()]
        if missing:
            raise TrilightError(f"--scenes {folder}: has no {missing[0]}; choose one that it has.")
        described = [comparison.described(root, name) for name in files]
    chosen = described + [comparison.sampled(index) for index in range(num_sampled)]
    if not chosen:
        raise TrilightError("no scene is chosen; give --scenes FOLDER or --sampled 1 or more.")
    return chosen


def _numbers(text: str, unit: int) -> tuple[int, ...]:
    words = text.split(",")
    if not all(word.isdecimal() and int(word) > 0 and int(word) % unit == 0 for word in words):
        raise TrilightError(f"samples are {text!r}; expected multiples of {unit} between commas.")
    return tuple(int(word) for word in words)


def _record(plan: Plan, results: list[SceneResult]) -> dict[str, Any]:
    return {
        "machine": harness.machine(),
        "blender": environment.BLENDER,
        "plan": dataclasses.asdict(plan),
        "scenes": [dataclasses.asdict(result) for result in results],
    }


def _table(results: list[SceneResult]) -> Table:
    table = Table(box=None)
    table.add_column("scene")
    table.add_column("renderer")
    for title in ("spp", "s", "core-s", "dB", "linear", "to Cycles: dB", "linear"):
        table.add_column(title, justify="right")
    for result in results:
        for shot in result.shots:
            errors = (
                shot.log_db,
                shot.linear_db,
                shot.log_db_to_cycles,
                shot.linear_db_to_cycles,
            )
            seconds = (f"{shot.render_s:.2f}", f"{shot.core_s:.2f}")
            shown = ["-" if error is None else f"{error:.1f}" for error in errors]
            table.add_row(result.name, shot.renderer, str(shot.spp), *seconds, *shown)
    return table


def _summary(plan: Plan, results: list[SceneResult]) -> str:
    """Return the medians of the ratios over the scenes that have them."""
    lines = []
    for title, ratio in (
        ("equal samples", comparison.ratio_at_equal_samples),
        ("equal error (to our reference)", comparison.ratio_at_equal_error),
    ):
        for spp in plan.cycles_spp:
            found = [value for result in results if (value := ratio(result, spp)) is not None]
            if found:
                lines.append(
                    f"Cycles {spp} / ours in core-seconds at {title}: median "
                    f"{np.median(found):.2f}, {min(found):.2f} to {max(found):.2f}, "
                    f"{len(found)} of {len(results)} scenes"
                )
    return "\n".join(lines)


if __name__ == "__main__":
    try:
        run(main)
    except TrilightError as mistake:
        sys.exit(f"infra.bench.cycles: {mistake}")
