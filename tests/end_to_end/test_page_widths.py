"""Every kind of page that Trilight writes fits its window, on a phone as on a desk."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from infra.release.page import write_page
from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.quality_page import Pair, encode_quality_page
from pipeline.documents.report import write_report
from tests.end_to_end.browser_kit import browser
from tests.infra.release.test_release import beside
from tests.pipeline.documents.dataset_by_hand import five_scenes
from tests.pipeline.documents.rows_by_hand import row
from tests.pipeline.documents.test_quality_page import failure

WIDTHS = (360, 390, 500, 768, 1280)
PAPER = {"light": "rgb(255, 255, 255)", "dark": "rgb(22, 24, 28)"}
BROKEN_NAMES = """[...document.querySelectorAll('table.narrow td:first-child, th')].filter(cell => {
    const lines = document.createRange(); lines.selectNodeContents(cell);
    return new Set([...lines.getClientRects()].map(box => Math.round(box.top))).size
        > cell.innerText.split(/[\\s-]+/).length }).map(cell => cell.innerText).join()"""
"""Names in tables that stand on more lines than they have words."""


def report(folder: Path) -> Path:
    dataset = five_scenes(folder)
    return write_report(dataset, dataset_distributions(dataset))


def scene(folder: Path) -> Path:
    report(folder)
    return min((folder / "report").glob("*.html"))


def gallery(folder: Path) -> Path:
    digest = f"smoke, digest {'0123456789abcdef' * 4}"
    shown = [beside("000000001", 31.0), beside("000000002", 28.0)]
    return write_page(folder, shown, about=[("dataset", digest), ("network", "builtin:hits")])


def quality(folder: Path) -> Path:
    entry = row("builtin/superquadric-00000")
    picture = np.full((256, 256), 128, np.uint8)
    pairs = [Pair(row=entry, source=picture, result=picture)] * 3
    folder.mkdir()
    page = folder / "quality.html"
    page.write_bytes(
        encode_quality_page([entry], [failure()], {"Worst": pairs}, budget=1400, target="faithful")
    )
    return page


PAGES: tuple[Callable[[Path], Path], ...] = (report, scene, gallery, quality)


@pytest.mark.slow("browser")  # a browser
def test_no_page_is_wider_than_its_window(tmp_path: Path) -> None:
    found = []
    with browser() as page:
        for kind in PAGES:
            address = kind(tmp_path / kind.__name__).as_uri()
            for scheme, paper in PAPER.items():
                page.in_colours(scheme)
                for width in WIDTHS:
                    page.show(width, 844)
                    page.open(f"{address}?{scheme}{width}")  # another address: loaded anew
                    wide = page.run("document.documentElement.scrollWidth")
                    shown = page.run("getComputedStyle(document.body).backgroundColor")
                    broken = page.run(BROKEN_NAMES)
                    if wide > width or shown != paper or broken:
                        found.append((kind.__name__, scheme, width, wide, shown, broken))
    assert found == []
