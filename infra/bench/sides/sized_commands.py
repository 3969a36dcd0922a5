"""What commands take on a dataset of any size, each alone in a fresh process.

The process first does the same on a small dataset, so that imports and caches of code do not count.
"""

import contextlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from storage.installation import IMPORT_ROOT

if TYPE_CHECKING:
    from pipeline.builds.settings import BuildSettings
    from pipeline.making.publication import Publication

_BATCH, _WINDOW = 4, 8
_FRACTION = 2
"""A run is resumed where this part of its epoch is behind it."""


@dataclass(frozen=True, kw_only=True)
class Sized:
    """A command, or what it does at a moment of its run."""

    of: Literal["outline", "whole"]
    """Which simulated dataset it is measured on (infra.bench.subjects.simulated_set)."""
    run: Callable[[Path], None]
    """Does it to the dataset of a folder."""


def measured(name: str, root: Path, small: Path) -> dict[str, float]:
    """Return what a command of COMMANDS takes on the dataset in `root`, `small` being a small one.

    `core_s` counts all threads, `peak_bytes` what the process grows by at most, `read_bytes` what
    it asked files for.
    """
    code = "import sys; from importlib import import_module as i; i(sys.argv[1]).main(sys.argv[2:])"
    words = [sys.executable, "-c", code, __name__, name, str(root), str(small)]
    ran = subprocess.run(words, cwd=IMPORT_ROOT, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, float] = json.loads(ran.stdout.splitlines()[-1])
    return found


def main(words: list[str]) -> None:
    """Measure one command in this process and print the figures as the last line."""
    name, root, small = words[0], Path(words[1]), Path(words[2])
    run = COMMANDS[name].run
    run(small)
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted anew from here
    held, read, began = _status("VmRSS"), _read_bytes(), time.process_time()
    run(root)
    core_s = time.process_time() - began
    figures = {
        "core_s": core_s,
        "peak_bytes": max(_status("VmHWM") - held, 1),
        "read_bytes": _read_bytes() - read,
    }
    sys.stdout.write(f"\n{json.dumps(figures)}\n")


def _status(field: str) -> int:
    # not getrusage: its peak counts the parent too, from before this program was begun
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(field))


def _read_bytes() -> int:
    return int(Path("/proc/self/io").read_text().split()[1])


def _words(*words: str) -> None:
    """Run the command line, whatever its exit status says of the dataset."""
    from infra.cli.commands import app

    with contextlib.suppress(SystemExit):
        app(words)


def _start(root: Path) -> None:
    """Begin as a task of an array does, up to its first piece."""
    from infra.bench.sides.maker_costs import TASK_SHARDS
    from pipeline.making.tasks import TaskSizes, cut_tasks

    with _joined(root) as publication:
        publication.refresh()
        last = publication.num_shards
        missing = publication.missing_shards(range(max(0, last - TASK_SHARDS), last))
        splits = _build().splits
        next(cut_tasks(missing, splits, TaskSizes()), None)


def _end(root: Path) -> None:
    """Note a shard and look whether any is missing, while another maker still has the last."""
    from infra.bench.subjects.simulated_set import SCENES_OF_OUTLINE, ShardTemplate, outlined

    with _joined(root) as publication:
        template = ShardTemplate("train", SCENES_OF_OUTLINE, first=0)
        last = publication.num_shards - 1
        publication.add_shard(outlined(last - 1, _build(), template))
        assert publication.finish() is None


def _finish(root: Path) -> None:
    """Note the shard that was missing, and list all."""
    from infra.bench.subjects.simulated_set import SCENES_OF_OUTLINE, ShardTemplate, outlined

    with _joined(root) as publication:
        template = ShardTemplate("train", SCENES_OF_OUTLINE, first=0)
        entry = outlined(publication.num_shards - 1, _build(), template)
        path = publication.folder.shard(entry.name)
        path.touch()
        os.truncate(path, entry.num_bytes)
        publication.add_shard(entry)
        assert publication.finish() is not None


@contextlib.contextmanager
def _joined(root: Path) -> "Iterator[Publication]":
    from pipeline.making.bucket_publication import begin_dataset, joined
    from pipeline.making.environment import environment
    from pipeline.renders.variant import choose_variant
    from storage.dataset.layout import DatasetFolder

    folder = DatasetFolder(root)
    with joined(folder):
        found = environment(choose_variant())
        yield begin_dataset(folder, _build(), found, 1, accept_environment=False)


def _build() -> "BuildSettings":
    from infra.bench.subjects.simulated_set import SCENES_OF_OUTLINE, simulated_build

    return simulated_build(SCENES_OF_OUTLINE)


def _plan(root: Path) -> None:
    """Predict a dataset of this size from scenes that are measured already, beginning it anew."""
    from infra.planning import MeasuredScenes, predict
    from pipeline.making.begin_publication import begin
    from pipeline.making.dataset_order import DatasetOrder
    from storage.dataset.layout import DatasetFolder
    from storage.dataset.manifest import read_manifest

    scenes = _planned_scenes(root)
    place = root.with_name(f"{root.name}-planned")
    begin(DatasetFolder(place), _build(), {}, scenes, accept_environment=False)
    assert read_manifest(DatasetFolder(place).manifest).num_scenes == scenes
    order = DatasetOrder(build="smoke", out=str(place), scenes=scenes)
    some = MeasuredScenes(core_s=(9.0, 8.0, 10.0), num_bytes=(10**6,) * 3, num_views=4)
    predict(some, order, cores=64, usd_per_core_hour=0.04)
    shutil.rmtree(place)


def _planned_scenes(root: Path) -> int:
    """Return the number in the first bytes of the manifest: reading it is not what is measured."""
    import re

    with (root / "manifest.json").open("rb") as stream:
        found = re.search(rb'"num_scenes": (\d+)', stream.read(1 << 16))
    assert found is not None
    return int(found[1])


def _open(root: Path) -> None:
    from storage.dataset.training_data import open_training_data

    open_training_data([str(root)]).split("train")


def _resume(root: Path) -> None:
    """Open, and read the batch in the middle of an epoch."""
    from storage.dataset.training_data import open_training_data
    from train.data.order import RankShare
    from train.data.stream import StreamSettings, stream_batches
    from train.data.unusable import Unusable

    settings = StreamSettings(
        seed=0, window=_WINDOW, batch_size=_BATCH, resolution=16, views_per_scene=1
    )
    shards = open_training_data([str(root)]).split("train")
    first = len(shards.names) // _FRACTION // _BATCH  # of shards of one scene each
    batches = stream_batches(
        shards, settings, first, share=RankShare(), workers=0, unusable=Unusable(0)
    )
    with closing(batches):
        assert len(next(iter(itertools.islice(batches, 1)))) == _BATCH


def _verify(root: Path) -> None:
    _words("verify", str(root), "--fast")


def _inspect(root: Path) -> None:
    out = root.with_name(f"{root.name}-inspected")
    out.mkdir()
    _words("inspect", str(root), "--out", str(out))
    shutil.rmtree(out)


def _merge(root: Path) -> None:
    """Merge it with a small one of other scenes."""
    _derive(root, "merge", str(root), str(root.with_name("other")))


def _select(root: Path) -> None:
    _derive(root, "select", str(root), "--split", "validation")


def _derive(root: Path, operation: str, *words: str) -> None:
    out = root.with_name(f"{root.name}-{operation}")
    _words("shards", operation, *words, "--out", str(out))
    assert (out / "manifest.json").exists()
    shutil.rmtree(out)


COMMANDS: Mapping[str, Sized] = {
    "generate, start": Sized(of="outline", run=_start),
    "status": Sized(of="outline", run=lambda root: _words("status", str(root))),
    "status --missing": Sized(
        of="outline", run=lambda root: _words("status", str(root), "--missing")
    ),
    "plan": Sized(of="outline", run=_plan),
    "open for training": Sized(of="outline", run=_open),
    "generate, end": Sized(of="outline", run=_end),
    "generate, last end": Sized(of="outline", run=_finish),
    "open for training, finished": Sized(of="outline", run=_open),
    "status, finished": Sized(of="outline", run=lambda root: _words("status", str(root))),
    "resume training": Sized(of="whole", run=_resume),
    "verify --fast": Sized(of="whole", run=_verify),
    "inspect": Sized(of="whole", run=_inspect),
    "shards select": Sized(of="whole", run=_select),
    "shards merge": Sized(of="whole", run=_merge),
}
"""What is measured, by name, in an order in which nothing spoils the dataset of what follows."""
