"""Experiment `growth`: time and memory against scenes, objects, triangles and shards.

A fresh process first does the work at the smallest size, so that imports and compiled kernels do
not count. The memory is that of the process and its children, sampled from outside.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from infra.bench.context import BenchContext, write_copies
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, rounds
from infra.bench.workloads.named_scenes import cost_scene
from infra.bench.workloads.traced_pictures import fixed_samples, render_shot
from infra.bench_options import BenchOptions
from pipeline.renders.mitsuba_variant import activate, choose_variant
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from storage.installation import IMPORT_ROOT, child_environment

_PX = 64
_LIGHTS = 4
_SAMPLING_S = 0.05
_CODE = "import sys; from importlib import import_module as i; i(sys.argv[1]).main(sys.argv[2:])"


@dataclass(frozen=True, kw_only=True)
class SizedWork:
    """Kind of work."""

    unit: str
    """Plural of the counted unit."""
    least: int
    """Smallest size; each further one is four times as large."""
    most: int
    """Maximum size, since a network's memory grows with the square of triangles."""
    do: Callable[[int, Path], None]
    """Function that does the work at a size, in an empty folder next to those of other sizes."""


def measure_work(name: str, size: int, folder: Path) -> dict[str, float]:
    """Return seconds and peak bytes of a kind of WORK at a size, in a fresh process.

    Args:
        folder: empty folder.

    Raises:
        TrilightError: the process failed.
    """
    words = [sys.executable, "-c", _CODE, __name__, name, str(size), str(folder)]
    with subprocess.Popen(
        words, cwd=IMPORT_ROOT, env=child_environment(), stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, start_new_session=True,
    ) as process:  # fmt: skip
        peak_bytes = 0
        output = None
        while output is None:
            try:
                output, _ = process.communicate(timeout=_SAMPLING_S)
            except subprocess.TimeoutExpired:  # nothing that it has written is lost
                peak_bytes = max(peak_bytes, session_bytes(process.pid))
    if process.returncode:
        said = output.strip().splitlines() or ["no message"]
        raise TrilightError(
            f"bench growth: {name} of {size} ended with exit status {process.returncode}: "
            f"{said[-1]}"
        )
    return {"seconds": float(json.loads(output.splitlines()[-1])), "peak_bytes": float(peak_bytes)}


def main(words: list[str]) -> None:
    """Do the work in this process and print its seconds as the last line."""
    work = WORK[words[0]]
    size = int(words[1])
    folder = Path(words[2])
    for number, count in enumerate((work.least, size)):
        place = folder / f"{number}"
        place.mkdir()
        began = time.perf_counter()
        work.do(count, place)
    sys.stdout.write(f"\n{json.dumps(time.perf_counter() - began)}\n")


def session_bytes(session: int) -> int:
    """Return the memory of all processes of a session; shared memory counts once."""
    total = 0
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            if int((folder / "stat").read_text().rpartition(")")[2].split()[3]) == session:
                lines = (folder / "smaps_rollup").read_text().splitlines()
                total += sum(1024 * int(line.split()[1]) for line in lines if line[:4] == "Pss:")
        except (OSError, IndexError):  # it ended meanwhile
            continue
    return total


def _run_command(*words: str) -> None:
    from infra.cli.commands import app

    app(words)


def _generate(num_scenes: int, folder: Path) -> None:
    _run_command(
        "generate", "smoke", "--out", str(folder / "set"), "--scenes", str(num_scenes),
        "--resolution", "16", "--noise-floor", "20", "--objects", "builtin:8",
        "--set", "splits.scenes_per_shard=2",
    )  # fmt: skip


def _prepare(num_objects: int, folder: Path) -> None:
    os.environ["TRILIGHT_CACHE"] = str(folder / "cache")  # every mesh is made anew
    _run_command("assets", f"builtin:{num_objects}", "--out", str(folder / "meshes"))


def _trace(num_triangles: int, folder: Path) -> None:
    activate(choose_variant())
    render_shot(cost_scene(num_triangles, _LIGHTS), fixed_samples(_PX, 64))


def _show_by_network(num_triangles: int, folder: Path) -> None:
    from model.inference import NeuralRenderer

    scene = cost_scene(num_triangles, _LIGHTS)
    renderer = NeuralRenderer.load("builtin:tokens", device="cpu")
    renderer.view(renderer.prepare(scene), scene.c2w[0], float(scene.fov_deg[0]), _PX)


def _read(num_shards: int, folder: Path) -> None:
    """Write shards of one sample each, open them for training, and read every sample once.

    The samples are copies of the one next to the folders of all sizes.
    """
    stored = folder.parents[1] / "sample"
    members = {path.name: path.read_bytes() for path in sorted(stored.iterdir())}
    write_copies(folder / "set", [members], copies=num_shards, per_shard=1)
    shards = open_training_data([str(folder / "set")]).split("train")
    for number in range(len(shards.names)):
        with closing(shards.open(number)) as shard:
            for key in shard.samples:
                shard.members(key)


WORK: Mapping[str, SizedWork] = {
    "generate a dataset": SizedWork(unit="scenes", least=2, most=512, do=_generate),
    "prepare meshes": SizedWork(unit="objects", least=4, most=1024, do=_prepare),
    "path trace a view": SizedWork(unit="triangles", least=256, most=1 << 18, do=_trace),
    "show a view by builtin:tokens": SizedWork(
        unit="triangles", least=256, most=4096, do=_show_by_network
    ),
    "write and read shards": SizedWork(unit="shards", least=16, most=1 << 14, do=_read),
}
"""Kinds of work by name."""


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    return [
        Point(
            name=f"{name}, {size:,} {work.unit}",
            measure=partial(_measure, name, size),
            kind=f"{name}, {work.unit}",
            size=float(size),
        )
        for name, work in WORK.items()
        for step in range(scale.growth)
        if (size := work.least * 4**step) <= work.most
    ]


def _measure(name: str, size: int, context: BenchContext, trial: str) -> Figures:
    root = context.get_or_make("root", lambda: _folder_with_sample(context))
    return measure_work(name, size, Path(tempfile.mkdtemp(dir=root)))


def _folder_with_sample(context: BenchContext) -> Path:
    """Return a folder with the files of one rendered scene, which the shards repeat."""
    root = context.folder()
    (root / "sample").mkdir()
    for name, data in context.rendered[0].items():
        (root / "sample" / name).write_bytes(data)
    return root


EXPERIMENT = Experiment(
    name="growth",
    title="Time and memory against the size of the work",
    cost=Column("seconds", "seconds"),
    columns=(Column("MB at most", "peak_bytes", then=lambda size: size / 1e6),),
    also_cost=("MB at most",),
    because="Seconds are on the clock; memory is that of the process and its children.",
    points=_points,
    trials=rounds,
    needs=("torch",),
)
