"""`quality.html`: a page on the results of the mesh stage for a folder of objects.

It is one file without scripts or external links; untrusted text is escaped.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.documents.figures import drawing, encode_figure, histogram, panels
from pipeline.documents.html import Markup, element, image, join_markup, page, png_uri, table
from storage.records.asset import AssetRow
from storage.records.objects import Failure

_STYLE = """
.pair { display: inline-block; width: min(530px, 100%); margin-bottom: 1.2rem;
  vertical-align: top } .pair p { margin: .2rem 0 }
@media (min-width: 40rem) { .pair { margin-right: 1.2rem } }
.pair img { width: 256px; max-width: 49%; background: #fff; border: 1px solid var(--rule);
  box-sizing: border-box }
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Pictures of one object before and after."""

    row: AssetRow
    """The object's row in the catalogue, with its quality figures."""
    source: NDArray[np.uint8]
    """[W, W] grey: the cleaned source."""
    result: NDArray[np.uint8]
    """[W, W] grey, or [W, W, 3] in its own materials: the level."""


def encode_quality_page(
    rows: Sequence[AssetRow],
    failures: Sequence[Failure],
    pairs: Mapping[str, Sequence[Pair]],
    unread: Mapping[str, Sequence[str]] = MappingProxyType({}),
    *,
    budget: int,
    target: str,
) -> bytes:
    """Return the page.

    Args:
        rows: the accepted objects.
        failures: the rejected objects.
        pairs: pictures by the name of their group.
        unread: unread parts of accepted objects, by uid.
        budget: most triangles of an object.
        target: target of the mesh stage, in words.
    """
    parts = [
        element("h1", f"Assets: {target}"),
        _summary(rows, failures),
        *([_histograms(rows, budget)] if rows else []),
        *(_group(name, group) for name, group in pairs.items() if group),
        *([_rejected_table(failures)] if failures else []),
        *([_unread_table(unread)] if unread else []),
        _accepted_table(rows),
    ]
    return page("Assets", join_markup(parts), style=_STYLE)


def _summary(rows: Sequence[AssetRow], failures: Sequence[Failure]) -> Markup:
    repaired = sum(row.source.repaired for row in rows)
    closed = sum(row.source.watertight for row in rows)
    licences = Counter(row.licence for row in rows)
    licence_text = ", ".join(f"{name} ({count})" for name, count in licences.most_common())
    return element(
        "p",
        f"{len(rows)} objects accepted, {repaired} of them repaired (triangles dropped or turned "
        f"outward), {closed} watertight; {len(failures)} rejected.",
        Markup("<br>"),
        f"Licences: {licence_text or 'none'}.",
        *_source_materials(rows),
    )


def _source_materials(rows: Sequence[AssetRow]) -> list[str | Markup]:
    """Return the number of objects with their own materials, and the reasons of the others."""
    requested = [row.materials for row in rows if row.materials is not None]
    if not requested:
        return []
    num_kept = sum(row.colours is not None for row in rows)
    reasons = Counter(materials.reason for materials in requested if materials.reason)
    lost = Counter(word for materials in requested for word in materials.lost)
    why = ", ".join(f"{name} ({count})" for name, count in reasons.most_common())
    unseen = ", ".join(f"{name} ({count})" for name, count in lost.most_common())
    text = f"In their own materials: {num_kept} of {len(rows)}"
    text += f"; the others: {why}." if why else "."
    return [Markup("<br>"), text + (f" Not shown of those: {unseen}." if unseen else "")]


def _histograms(rows: Sequence[AssetRow], budget: int) -> Markup:
    """Draw error, triangle quality and budget as one picture."""
    changed = [100 * row.quality.error_p99 for row in rows if row.method != "source"]
    angles = [row.quality.min_angle_p5_deg for row in rows]
    areas = [row.quality.area_variation for row in rows]
    faces = [row.num_faces for row in rows]
    distances = f"p99 distance, % of the diagonal\n({len(changed)} decimated objects)"
    smallest = "smallest angles, 5th percentile, degrees\n(60: equilateral)"
    with drawing():
        figure, axes = panels(4, columns=4)
        histogram(axes[0], changed, distances, ylabel="objects")
        histogram(axes[1], angles, smallest, bounds=(0, 60))
        histogram(axes[2], areas, "variation of triangle areas\n(0: all equal)")
        histogram(axes[3], faces, f"triangles\n(budget {budget})", bounds=(0, budget))
        return encode_figure(figure, "histograms")


def _group(name: str, pairs: Sequence[Pair]) -> Markup:
    return join_markup([element("h2", name), *(_pair(pair) for pair in pairs)])


def _pair(pair: Pair) -> Markup:
    row = pair.row
    quality = pair.row.quality
    facts = (
        f"{row.source.num_faces} to {row.num_faces} triangles by {row.method}; p99 "
        f"{quality.error_p99:.2%}, largest {quality.error_max:.2%}, normals "
        f"{quality.normal_error_deg:.1f}°, outline {quality.silhouette_iou:.1%}"
    )
    if row.colours is not None:
        facts += (
            f"; colours {row.colours.colour_error:.4f} on average, "
            f"{row.colours.torn_seams:.1%} of the seams torn"
        )
    return element(
        "div",
        image(png_uri(pair.source), "source"),
        " ",
        image(png_uri(pair.result), "result"),
        element("p", row.uid, " ", element("span", facts, class_="faint")),
        class_="pair",
    )


def _rejected_table(failures: Sequence[Failure]) -> Markup:
    cells = [(row.item, row.reason, row.message) for row in failures]
    return join_markup(
        [element("h2", "Rejected"), table(("object", "reason", "what was found"), cells)]
    )


def _unread_table(unread: Mapping[str, Sequence[str]]) -> Markup:
    cells = [(uid, ", ".join(unread[uid])) for uid in sorted(unread)]
    heading = element("h2", "Not read")
    return join_markup([heading, table(("object", "what its file holds beside that"), cells)])


def _materials_of(row: AssetRow) -> str:
    if row.colours is not None:
        return "own"
    return f"drawn: {row.materials.reason}" if row.materials else "drawn"


def _accepted_table(rows: Sequence[AssetRow]) -> Markup:
    has_materials = any(row.materials for row in rows)
    texts = ("object", "licence", "method", *(["materials"] if has_materials else []))
    head = (*texts, "read", "triangles", "p99 %", "normals", "open edges")
    cells = [
        (
            row.uid,
            row.licence,
            row.method + (", repaired" if row.source.repaired else ""),
            *([_materials_of(row)] if has_materials else []),
            f"{row.source.num_faces_read}",
            f"{row.num_faces}",
            f"{100 * row.quality.error_p99:.2f}",
            f"{row.quality.normal_error_deg:.1f}",
            f"{row.quality.open_edges}",
        )
        for row in sorted(rows, key=lambda row: (-row.quality.error_p99, row.uid))
    ]
    heading = element("h2", "Accepted, the largest error first")
    return join_markup([heading, table(head, cells, numbers=5)])
