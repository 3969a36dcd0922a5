"""`quality.html`: a page on the results of the mesh stage for a folder of objects.

It is one file without scripts or external links; untrusted text is escaped.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pipeline.documents.figures import Panel, draw_panels
from pipeline.documents.pages import data_uri, render_page
from storage.records.asset import AssetRow
from storage.records.objects import Failure


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
        rows: the accepted objects; `failures` are the rejected ones.
        pairs: pictures by the name of their group.
        unread: unread parts of accepted objects, by uid.
        budget: most triangles of an object.
        target: target of the mesh stage, in words.
    """
    requests = [row.materials for row in rows if row.materials is not None]
    return render_page(
        "quality.html",
        "Assets",
        target=target,
        rows=sorted(rows, key=lambda row: (-row.quality.error_p99, row.uid)),
        failures=failures,
        groups=pairs,
        unread=unread,
        licences=Counter(row.licence for row in rows),
        asked=requests,
        reasons=Counter(materials.reason for materials in requests if materials.reason),
        lost=Counter(word for materials in requests for word in materials.lost),
        figure=data_uri(_draw_histograms(rows, budget)) if rows else "",
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
