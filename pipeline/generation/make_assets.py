"""Runs the mesh stage alone: from a source of objects to clean meshes and a quality report."""

import contextlib
import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import clean, geometry_sha256, normalize
from pipeline.assets.preview import preview_source_and_level
from pipeline.assets.recipe import RECIPE, library_versions
from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedObject
from pipeline.documents.figures import Panel, draw_panels
from pipeline.documents.pages import data_uri, render_page
from pipeline.documents.rights import encode_attribution
from pipeline.exchange.gltf import encode_mesh_glb
from pipeline.foreign.mesh import TriangleMesh
from pipeline.generation.prepare_isolated import (
    UnreadNotes,
    asset_child,
    asset_store,
    mesh_stage,
    write_unread,
)
from pipeline.isolation import ChildFailed, call_with_retries, reach
from pipeline.objects.generated import encode_ply
from pipeline.objects.sources import list_objects
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.dataset.layout import Below
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.asset import Asset, AssetRow, Level, decode_asset
from storage.records.objects import Failure, ObjectRecord, write_failures
from storage.settings.described import settings_record

_PICTURES = 4
"""Objects in each of the groups worst, median and best."""
_WIDTH_PX = 256


@dataclass(frozen=True)
class AssetFolder:
    """The paths that `trilight assets` writes."""

    root: Path
    """The folder that `--out` names."""

    summary = Below("assets.json")
    catalogue = Below("objects.jsonl")
    failures = Below("failures.jsonl")
    attribution = Below("attribution.csv")
    page = Below("quality.html")
    logs = Below("logs")
    meshes = Below("meshes")


Pair = tuple[AssetRow, NDArray[np.uint8], NDArray[np.uint8]]
"""An object's row, its cleaned source [W, W] in grey, and the level, also as [W, W, 3] in color."""


@dataclass(frozen=True, kw_only=True)
class AssetReport:
    """The result of the mesh stage for all objects of a source."""

    rows: tuple[AssetRow, ...]
    """The accepted objects, in the order of their uids."""
    failures: tuple[Failure, ...]
    geometry_sha256: tuple[str, ...]
    """Digest of the geometry of each written mesh, by which `generate` assigns it to a split."""
    unread: UnreadNotes
    """Unread parts of the accepted objects' files."""

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of objects; the repaired ones have dropped or flipped triangles."""
        repaired = sum(row.source.repaired for row in self.rows)
        return {"accepted": len(self.rows), "repaired": repaired, "rejected": len(self.failures)}

    def as_json(self) -> dict[str, Any]:
        """Return counts and one row per object."""
        return {
            **self.counts,
            "objects": [row.as_json() for row in self.rows],
            "failures": [dataclasses.asdict(failure) for failure in self.failures],
            "unread": dict(self.unread),
        }


def make_assets(
    source: str,
    folder: AssetFolder,
    settings: AssetSettings,
    *,
    allowed_licences: Sequence[str],
    licence: str | None,
    workers: int,
    on_download: Callable[[int, int], None],
    on_plan: Callable[[int], None],
    on_object: Callable[[], None],
) -> AssetReport:
    """Prepare the objects of a source and write the folder; a repeated call uses the asset store.

    Args:
        source: source of objects, as `list_objects` takes it.
        folder: an empty folder, or one of an earlier call, which is replaced.
        settings: settings of the mesh stage with one budget: the folder has one mesh per object.
        allowed_licences: objects under other licences are rejected.
        licence: licence of files that state none.
        workers: number of objects that are prepared at the same time.
        on_download: called with the number of finished downloads and their total.
        on_plan: called with the number of objects, once it is known.
        on_object: called after each object, from any thread.

    Raises:
        TrilightError: the source is unusable, or the folder holds other files or cannot be
            written.
    """
    if workers < 1:
        raise TrilightError(f"workers is {workers}; expected at least 1.")
    _require_ours(folder)
    listed = list_objects(
        source,
        work_dir=cache_folder("objects"),
        allowed_licences=allowed_licences,
        licence=licence,
    ).fetch_selected(downloaded=on_download)
    write_atomically(folder.summary, b"{}")  # from here on the folder is ours
    on_plan(len(listed.records))
    with mesh_stage(settings, workers) as prepare:
        prepared, rejected = prepare(list(listed.records), on_object)
    store = asset_store()
    assets = [decode_asset(store.asset_path(each.asset_name).read_bytes()) for each in prepared]
    levels = [asset.levels[0] for asset in assets]
    rows = [_row(each.record, asset) for each, asset in zip(prepared, assets, strict=True)]
    report = AssetReport(
        rows=tuple(rows),
        failures=tuple(sorted([*listed.failures, *rejected], key=lambda row: row.item)),
        geometry_sha256=tuple(map(_geometry_sha256, levels)),
        unread={asset.record.uid: asset.unread for asset in prepared if asset.unread},
    )
    _write(folder, settings, report, levels, _pairs(prepared, rows, levels, settings))
    return report


def _require_ours(folder: AssetFolder) -> None:
    if folder.root.exists() and not folder.root.is_dir():
        raise TrilightError(f"{folder.root}: is a file; expected a folder. Choose another --out.")
    if folder.root.is_dir() and any(folder.root.iterdir()) and not folder.summary.exists():
        raise TrilightError(
            f"{folder.root}: holds files that `trilight assets` did not write; expected a new or "
            "empty folder. Choose another --out."
        )


def _geometry_sha256(level: Level) -> str:
    """Return the digest that the mesh stage would compute for the written file of a level."""
    positions = level.positions.astype(np.float64)
    faces = level.faces.astype(np.int64)
    return geometry_sha256(clean(normalize(TriangleMesh(positions=positions, faces=faces))))


def _row(record: ObjectRecord, asset: Asset) -> AssetRow:
    (level,) = asset.levels
    # a file name that is safe on every system: a uid is untrusted text
    readable = re.sub(r"[^A-Za-z0-9]+", "-", record.uid).strip("-")[-60:]
    digest = hashlib.sha256(record.uid.encode()).hexdigest()[:8]
    return AssetRow(
        **record.identity,
        path=f"meshes/{readable}-{digest}{'.ply' if level.skin is None else '.glb'}",
        num_faces=len(level.faces),
        method=level.record.method,
        quality=level.record.quality,
        source=asset.source,
        materials=asset.materials,
        colours=None if level.skin is None else level.skin.quality,
    )


def _write(
    folder: AssetFolder,
    settings: AssetSettings,
    report: AssetReport,
    levels: list[Level],
    pairs: dict[str, list[Pair]],
) -> None:
    for row, level in zip(report.rows, levels, strict=True):
        skin = level.skin
        mesh = (
            encode_ply(level.positions, level.faces)
            if skin is None
            else encode_mesh_glb(level.positions, level.faces, skin.uv, skin.textures)
        )
        write_atomically(folder.root / row.path, mesh)
    written = {folder.root / row.path for row in report.rows}
    for path in (*folder.meshes.glob("*.ply"), *folder.meshes.glob("*.glb")):
        if path not in written:
            path.unlink()
    lines = [canonical_json(row.as_json()) + b"\n" for row in report.rows]
    write_atomically(folder.catalogue, b"".join(lines))
    write_failures(folder.failures, report.failures)
    write_unread(folder.logs, report.unread)
    write_atomically(folder.attribution, encode_attribution(report.rows))
    summary = {
        **report.counts,
        "recipe": RECIPE,
        "libraries": library_versions(),
        "settings": settings_record(settings),
    }
    write_atomically(folder.summary, json.dumps(summary, indent=1, sort_keys=True).encode())
    write_atomically(folder.page, encode_quality_page(report, settings, pairs))


def _pairs(
    prepared: list[PreparedObject],
    rows: list[AssetRow],
    levels: list[Level],
    settings: AssetSettings,
) -> dict[str, list[Pair]]:
    """Return pictures of source and result for the worst, the median and the best objects."""
    changed = sorted(
        (i for i, row in enumerate(rows) if row.method != "source" or row.colours is not None),
        key=lambda index: (-rows[index].quality.error_p99, rows[index].uid),
    )
    middle = max(0, len(changed) // 2 - _PICTURES // 2)
    groups = {
        "Worst": changed[:_PICTURES],
        "Median": changed[middle : middle + _PICTURES],
        "Best": changed[-_PICTURES:],
    }
    pairs: dict[str, list[Pair]] = {name: [] for name in groups}
    with contextlib.closing(asset_child()) as child:
        for name, indices in groups.items():
            for i in indices:
                path = prepared[i].record.path
                child.allow_files(reach([Path(path)]))
                with contextlib.suppress(ChildFailed):  # a missing picture must not stop the run
                    source, result = call_with_retries(
                        child, preview_source_and_level, path, settings, levels[i], _WIDTH_PX
                    )
                    pairs[name].append((rows[i], source, result))
    return pairs


def encode_quality_page(
    report: AssetReport, settings: AssetSettings, pairs: Mapping[str, Sequence[Pair]]
) -> bytes:
    """Return `quality.html`: one file without scripts or external links; text is escaped.

    Args:
        pairs: pictures by the name of their group.
    """
    rows = report.rows
    figure = data_uri(_draw_histograms(rows, settings.budgets[0])) if rows else ""
    return render_page(
        "quality.html", "Assets", report=report, settings=settings, groups=pairs, figure=figure
    )


def _draw_histograms(rows: Sequence[AssetRow], budget: int) -> bytes:
    """Draw error, triangle quality and budget as one picture."""
    changed = [100 * row.quality.error_p99 for row in rows if row.method != "source"]
    panels = [
        Panel(
            values=changed,
            label=f"p99 distance, % of the diagonal\n({len(changed)} decimated objects)",
            unit="objects",
        ),
        Panel(
            values=[row.quality.min_angle_p5_deg for row in rows],
            label="smallest angles, 5th percentile, degrees\n(60: equilateral)",
            bounds=(0, 60),
        ),
        Panel(
            values=[row.quality.area_variation for row in rows],
            label="variation of triangle areas\n(0: all equal)",
        ),
        Panel(
            values=[row.num_faces for row in rows],
            label=f"triangles\n(budget {budget})",
            bounds=(0, budget),
        ),
    ]
    return draw_panels(panels, columns=4)
