"""Times the components of previews on this machine, for `trilight render --seconds` and `--error`.

Two scenes of the shipped table are made again and timed, on one thread and on all. Each shipped
cost is multiplied by this machine's time relative to that of the table's machine: times of a sample
differ by a factor of two between scenes, and two scenes are not the table's twelve.
"""

import contextlib
import importlib.util
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from infra.render.held_out_scenes import composing_child, held_out_scene, held_out_settings
from infra.render.networks import NetworkRenderer
from infra.render.preview_table import (
    NETWORK_SCENE,
    NETWORK_VIEW,
    PartCost,
    PictureCosts,
    PreviewTable,
    machine_name,
)
from pipeline.objects.generated import BENCHMARK
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.preview import timed_parts
from pipeline.renders.renderer import set_threads
from storage.machine import available_cores
from storage.records.scene import Scene
from storage.renderer import Camera

PROBES = (1, 2)
"""Numbers of the held-out scenes that every machine times."""

PROBED_PX = (64, 256)
"""Widths in pixels that are timed; ratios at other widths are interpolated or those of the end."""

PartSeconds = dict[tuple[int, int], Mapping[str, float]]
"""Seconds of each part by (width, threads)."""


def measure_costs(table: PreviewTable) -> PictureCosts:
    """Return the costs of the parts here; takes less than a minute on an idle machine."""
    cores = available_cores()
    variant = choose_variant("auto")
    with tempfile.TemporaryDirectory() as name:
        child = composing_child(held_out_settings(), BENCHMARK, Path(name), variant=variant)
        with contextlib.closing(child):
            scenes = [held_out_scene(child, index) for index in PROBES]
            timed = [_time_scene(child, scene, cores) for scene in scenes]
    mean: PartSeconds = {
        key: {part: float(np.mean([one[key][part] for one in timed])) for part in timed[0][key]}
        for key in timed[0]
    }
    return costs_of(table, mean, cores, machine_name(variant))


def costs_of(table: PreviewTable, timed: PartSeconds, cores: int, machine: str) -> PictureCosts:
    """Return the shipped costs times the ratio of this machine's time to the table's.

    Args:
        table: shipped table, with the CPU seconds of the probes.
        timed: mean seconds of the probes' parts, on one thread and on `cores`; a part without a
            time keeps its shipped cost.
        cores: maximum number of threads.
    """
    then = {(row.part, row.width): row.serial_s + row.parallel_s for row in table.probe.rows}
    rows = []
    for row in table.costs.rows:
        shares = [
            _serial_and_parallel(timed[px, 1][row.part], timed[px, cores][row.part], cores)
            / max(then[row.part, px], 1e-9)
            for px in PROBED_PX
            if row.part in timed[px, 1]
        ]
        if not shares:
            rows.append(row)
            continue
        at = np.interp(np.log2(row.width), np.log2(PROBED_PX), range(len(PROBED_PX)))
        serial, parallel = (1 - at) * shares[0] + at * shares[-1]
        core_s = row.serial_s + row.parallel_s
        rows.append(
            PartCost(
                part=row.part,
                width=row.width,
                serial_s=float(f"{core_s * serial:.4g}"),
                parallel_s=float(f"{core_s * parallel:.4g}"),
            )
        )
    return PictureCosts(machine=machine, rows=tuple(rows))


def _serial_and_parallel(one_s: float, all_s: float, cores: int) -> Any:
    """Return [serial, parallel] seconds s and p with s + p = `one_s` and s + p / cores = `all_s`.

    Where one of them would be negative, it is 0 and the other is `one_s`.
    """
    if cores == 1:
        return np.array([0.0, one_s])
    parallel = float(np.clip((one_s - all_s) * cores / (cores - 1), 0.0, one_s))
    return np.array([one_s - parallel, parallel])


def _time_scene(child: Any, scene: Scene, cores: int) -> PartSeconds:
    seconds: PartSeconds = {}
    for threads in {1, cores}:
        networks = _network_parts(scene, threads)
        for px in PROBED_PX:
            parts = child.call(parts_with_threads, scene, px, threads)
            seconds[px, threads] = {**parts, **networks.get(px, {})}
    return seconds


def parts_with_threads(scene: Scene, resolution: int, threads: int) -> dict[str, float]:
    """Return `timed_parts` with a number of threads; runs in a render child."""
    set_threads(threads)
    return timed_parts(scene, resolution)


def _network_parts(scene: Scene, threads: int) -> dict[int, dict[str, float]]:
    """Return seconds of the network's parts by width; none where torch is not installed."""
    if importlib.util.find_spec("torch") is None:
        return {}
    seconds = {}
    for px in PROBED_PX:
        renderer = NetworkRenderer(checkpoint="builtin:tokens", resolution=px, threads=threads)
        spent = []
        for _ in range(4):
            loaded = renderer.load(scene, "scene")
            began = time.perf_counter()
            loaded.render(Camera.of_scene(scene, 0))
            spent.append((loaded.seconds, time.perf_counter() - began))
        encoding_s, view_s = np.median(spent[1:], axis=0)  # the first allocates memory and threads
        seconds[px] = {NETWORK_SCENE: float(encoding_s), NETWORK_VIEW: float(view_s)}
    return seconds
