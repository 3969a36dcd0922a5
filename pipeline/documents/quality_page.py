"""`quality.html`: what the mesh stage did to a folder of objects, for people to look at.

One file without scripts or links to elsewhere; text from outside is escaped.
"""

import base64
import html
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from storage.asset_rows import AssetRow
from storage.records import Failure

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; color: #222 }
h1, h2 { font-weight: 600 } table { border-collapse: collapse; width: 100% }
td, th { text-align: left; padding: .2rem .7rem .2rem 0; border-bottom: 1px solid #ddd }
td.n, th.n { text-align: right }
.pair { display: inline-block; width: 530px; margin: 0 1.2rem 1.2rem 0; vertical-align: top }
.pair img { width: 256px; background: #fff; border: 1px solid #ddd } .pair p { margin: .2rem 0 }
.faint { color: #777 } img.wide { max-width: 100% }
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Pictures of one object before and after."""

    row: AssetRow
    """What is known of it."""
    source: NDArray[np.uint8]
    """[W, W] grey: the cleaned source."""
    result: NDArray[np.uint8]
    """[W, W] grey: the level."""


def encode_quality_page(
    rows: Sequence[AssetRow],
    failures: Sequence[Failure],
    pairs: Mapping[str, Sequence[Pair]],
    *,
    budget: int,
    target: str,
) -> bytes:
    """Return the page.

    Args:
        rows: the accepted objects.
        failures: the rejected ones.
        pairs: pictures by the name of their group.
        budget: most triangles of an object.
        target: what was asked for, in words.
    """
    parts = [
        f"<h1>Assets: {target}</h1>",
        _summary(rows, failures),
        f'<img class="wide" alt="histograms" src="{_histograms(rows, budget)}">' if rows else "",
        *(_group(name, group) for name, group in pairs.items() if group),
        _rejected(failures),
        _accepted(rows),
    ]
    body = "\n".join(part for part in parts if part)
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Assets</title>'
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )
    return page.encode()


def _summary(rows: Sequence[AssetRow], failures: Sequence[Failure]) -> str:
    repaired = sum(row.source.repaired for row in rows)
    closed = sum(row.source.watertight for row in rows)
    licences = Counter(row.licence for row in rows)
    shown = ", ".join(f"{html.escape(name)} ({count})" for name, count in licences.most_common())
    return (
        f"<p>{len(rows)} objects accepted, {repaired} of them repaired (triangles dropped or "
        f"turned outward), {closed} watertight; {len(failures)} rejected.<br>Licences: "
        f"{shown or 'none'}.</p>"
    )


def _histograms(rows: Sequence[AssetRow], budget: int) -> str:
    """Draw error, triangle quality and budget as one picture."""
    figure, axes = plt.subplots(1, 4, figsize=(14, 2.8), layout="constrained")
    changed = [row.quality for row in rows if row.method != "source"]
    axes[0].hist([100 * quality.error_p99 for quality in changed], bins=24)
    axes[0].set_xlabel(f"p99 distance, % of the diagonal\n({len(changed)} decimated objects)")
    axes[0].set_ylabel("objects")
    axes[1].hist([row.quality.min_angle_p5_deg for row in rows], bins=24, range=(0, 60))
    axes[1].set_xlabel("smallest angles, 5th percentile, degrees\n(60: equilateral)")
    axes[2].hist([row.quality.area_variation for row in rows], bins=24)
    axes[2].set_xlabel("variation of triangle areas\n(0: all equal)")
    axes[3].hist([row.num_faces for row in rows], bins=24, range=(0, budget))
    axes[3].set_xlabel(f"triangles\n(budget {budget})")
    stream = io.BytesIO()
    figure.savefig(stream, dpi=110, metadata={"Software": None})
    plt.close(figure)
    return _data_uri(stream.getvalue())


def _group(name: str, pairs: Sequence[Pair]) -> str:
    return f"<h2>{name}</h2>\n" + "\n".join(_pair(pair) for pair in pairs)


def _pair(pair: Pair) -> str:
    row, quality = pair.row, pair.row.quality
    return (
        f'<div class="pair"><img alt="source" src="{_png(pair.source)}"> '
        f'<img alt="result" src="{_png(pair.result)}">'
        f'<p>{html.escape(row.uid)} <span class="faint">{row.source.num_faces} to {row.num_faces} '
        f"triangles by {row.method}; p99 {quality.error_p99:.2%}, largest {quality.error_max:.2%}, "
        f"normals {quality.normal_error_deg:.1f}&deg;, outline "
        f"{quality.silhouette_iou:.1%}</span></p></div>"
    )


def _rejected(failures: Sequence[Failure]) -> str:
    if not failures:
        return ""
    cells = [(row.item, row.reason, row.message) for row in failures]
    return "<h2>Rejected</h2>\n" + _table(("object", "reason", "what was found"), cells, numbers=0)


def _accepted(rows: Sequence[AssetRow]) -> str:
    head = ("object", "licence", "method", "read", "triangles", "p99 %", "normals", "open edges")
    cells = [
        (
            row.uid,
            row.licence,
            row.method + (", repaired" if row.source.repaired else ""),
            f"{row.source.num_faces_read}",
            f"{row.num_faces}",
            f"{100 * row.quality.error_p99:.2f}",
            f"{row.quality.normal_error_deg:.1f}",
            f"{row.quality.open_edges}",
        )
        for row in sorted(rows, key=lambda row: (-row.quality.error_p99, row.uid))
    ]
    return "<h2>Accepted, the largest error first</h2>\n" + _table(head, cells, numbers=5)


def _table(head: Sequence[str], cells: Sequence[Sequence[str]], *, numbers: int) -> str:
    """Return a table whose last `numbers` columns are aligned to the right."""
    first = len(head) - numbers

    def line(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{' class=n' if k >= first else ''}>{html.escape(cell)}</{tag}>"
            for k, cell in enumerate(row)
        )

    body = "\n".join(f"<tr>{line('td', row)}</tr>" for row in cells)
    return f"<table><tr>{line('th', head)}</tr>\n{body}</table>"


def _png(grey: NDArray[np.uint8]) -> str:
    stream = io.BytesIO()
    Image.fromarray(grey).save(stream, "PNG", optimize=True)
    return _data_uri(stream.getvalue())


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
