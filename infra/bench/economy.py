"""What the scenes of a dataset cost part by part, and what was left out, from its own records.

    python -m infra.bench.economy SET [--write]

Reads every sample of a finished dataset and prints a table; `--write` puts it into docs/economy.md.
The sources' triangles are looked up in this machine's asset store: make the set here.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter, run

from infra.bench.economy_counts import SceneCosts, scene_costs
from infra.bench.economy_line import Line, base_flops
from infra.bench.economy_totals import HALF_BYTES, PASSES, in_all, passes
from infra.bench.harness import ROOT
from infra.bench.marked_block import write_block
from infra.bench.model.workloads import PUBLISHED_LENGTH
from infra.bench.trade.figures import shown
from infra.cli.console import console
from storage.dataset import Dataset, open_dataset
from storage.errors import TrilightError
from storage.renderformer_h5 import CELLS, CHANNELS, write_renderformer_h5

MARK = "economy"
_HDF5_SCENES = 24
"""Written in the published form: half a second each."""


def main(
    dataset: Annotated[str, Parameter(help="root of a finished dataset")],
    write: Annotated[bool, Parameter(help="write docs/economy.md")] = False,
) -> None:
    """Count and print."""
    opened = open_dataset(dataset)
    found = list(scene_costs(opened))
    if not found:
        raise TrilightError(f"{opened.shown}: no scene; expected a finished dataset.")
    text = "\n".join(table(opened, found)) + "\n"
    console.print(text, soft_wrap=True, markup=False)
    if write:
        write_block(ROOT / "docs" / "economy.md", MARK, text)


def table(dataset: Dataset, found: Sequence[SceneCosts]) -> list[str]:
    """Return the table as lines of Markdown."""
    manifest = dataset.manifest
    px = int(manifest.settings["renders"]["resolution"])
    head = (
        f"Set: {len(found)} scenes of `{manifest.build}`, {manifest.num_views} views of {px} x "
        f"{px} each; means per scene, from manifest, samples and asset store (`python -m "
        "infra.bench.economy SET --write`)."
    )
    renders = manifest.settings["renders"]
    published, same = _published_bytes(dataset, found)
    lines = [
        *_geometry(found, px),
        *_smallest(found, px),
        passes(found, renders),
        _samples(found, int(renders["max_spp"])),
        *_bytes(dataset, found, px, (published, same)),
        *in_all(found, manifest.settings, published_bytes=published),
    ]
    rows = [
        f"| {line.part} | {line.everything} | {line.kept} | {shown(line.factor)} x | {line.error} |"
        for line in lines
    ]
    return [
        head,
        "",
        "| part | with everything | what is kept | saving | error that it adds |",
        "|---|---|---|---|---|",
        *rows,
    ]


def _geometry(found: Sequence[SceneCosts], px: int) -> list[Line]:
    sources = sum(one.source_faces for one in found)
    objects = sum(one.object_faces for one in found)
    views = len(found[0].spp)
    padded = base_flops(PUBLISHED_LENGTH.get(px, max(PUBLISHED_LENGTH.values())), views, px)
    counted = float(np.mean([base_flops(one.triangles, views, px) for one in found]))
    empty = float(np.mean([one.empty_share for one in found]))
    scenes = len(found)
    return [
        Line(
            part="triangles of the objects",
            everything=f"{sources / scenes:.0f} in their sources",
            kept=f"{objects / scenes:.0f}",
            factor=sources / max(objects, 1),
            error="p99 distance at most 3 % of an object, the bound of the mesh stage",
        ),
        Line(
            part="FLOPs of all views (Base)",
            everything=f"{padded / 1e9:.0f} G, padded as published",
            kept=f"{counted / 1e9:.0f} G, the scene's own triangles",
            factor=padded / counted,
            error="none",
        ),
        Line(
            part="ray bundles that see nothing",
            everything="all are computed",
            kept=f"all; --skip-empty-bundles would leave out {100 * empty:.0f} %",
            factor=1.0,
            error="none; much where they are left out (docs/tradeoffs.md)",
        ),
    ]


def _smallest(found: Sequence[SceneCosts], px: int) -> list[Line]:
    """Return what the least scene of the set takes of the most."""
    least = min(found, key=lambda one: one.triangles)
    most = max(found, key=lambda one: one.triangles)
    costs = [base_flops(one.triangles, len(one.spp), px) / 1e9 for one in (most, least)]
    sizes = [one.array_bytes / 1e3 for one in (most, least)]
    return [
        Line(
            part=f"the smallest scene, {least.triangles} triangles: {what}",
            everything=f"{of_most:.1f} {unit} for {most.triangles} triangles",
            kept=f"{of_least:.1f} {unit}, {100 * of_least / of_most:.0f} %",
            factor=of_most / of_least,
            error="none",
        )
        for what, unit, (of_most, of_least) in (("FLOPs", "G", costs), ("arrays", "kB", sizes))
    ]


def _samples(found: Sequence[SceneCosts], most: int) -> Line:
    spent = np.array([spp for one in found for spp in one.spp], np.float64)
    at_cap = np.mean([capped for one in found for capped in one.at_cap])
    floors = np.array([floor for one in found for floor in one.floors_db])
    return Line(
        part="samples of a pixel",
        everything=f"{most}, the cap, in every view",
        kept=f"{spent.mean():.0f}; {100 * at_cap:.0f} % of the views end at the cap",
        factor=most / float(spent.mean()),
        error=f"stated per view: median floor {np.median(floors):.1f} dB, 5th percentile "
        f"{np.percentile(floors, 5):.1f}",
    )


def _bytes(
    dataset: Dataset, found: Sequence[SceneCosts], px: int, hdf5: tuple[float, float]
) -> list[Line]:
    arrays = float(np.mean([one.array_bytes + one.record_bytes for one in found]))
    pictures = float(np.mean([one.picture_bytes for one in found]))
    published, same = hdf5
    texture = np.mean([one.triangles for one in found]) * CHANNELS * CELLS**2 * HALF_BYTES
    raw = len(found[0].spp) * px * px * PASSES["colour"] * HALF_BYTES
    profile = dataset.manifest.settings["storage"]["profile"]
    added = "none" if profile == "lossless" else "at most a tenth of each view's own noise"
    return [
        Line(
            part="arrays and record on disk",
            everything=f"{published / 1e3:.0f} kB, the published HDF5 with half-float textures",
            kept=f"{same / 1e3:.1f} kB, the first {min(len(found), _HDF5_SCENES)} scenes",
            factor=published / same,
            error="none",
        ),
        Line(
            part="materials in memory",
            everything=f"{texture / 1e6:.1f} MB of textures",
            kept=f"{arrays / 1e3:.1f} kB for all arrays and the record",
            factor=float(texture / arrays),
            error="none: the textures are constant",
        ),
        Line(
            part=f"pictures (`{profile}`)",
            everything=f"{raw / 1e3:.0f} kB of half floats",
            kept=f"{pictures / 1e3:.0f} kB",
            factor=raw / pictures,
            error=added,
        ),
        Line(
            part="a whole sample",
            everything=f"{(published + raw) / 1e3:.0f} kB",
            kept=f"{(arrays + pictures) / 1e3:.0f} kB",
            factor=(published + raw) / (arrays + pictures),
            error=f"in pictures only: {added}",
        ),
    ]


def _published_bytes(dataset: Dataset, found: Sequence[SceneCosts]) -> tuple[float, float]:
    """Return bytes a scene as HDF5, and as stored here, of the same first scenes."""
    total, count = 0, 0
    with tempfile.TemporaryDirectory() as folder:
        for shard in dataset.manifest.shards:
            for record in dataset.read_scenes(shard):
                if count == _HDF5_SCENES:
                    break
                path = Path(folder, f"{record.key}.h5")
                write_renderformer_h5(path, record.scene, texture_type="float16")
                total, count = total + path.stat().st_size, count + 1
    same = [one.array_bytes + one.record_bytes for one in found[:count]]
    return total / count, float(np.mean(same))


if __name__ == "__main__":
    try:
        run(main)
    except TrilightError as mistake:
        raise SystemExit(f"economy: {mistake}") from mistake
