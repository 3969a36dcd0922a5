"""Pages that Trilight writes, in a browser: they fit, and a person looks around."""

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


SHOWN = """[...document.querySelectorAll('.card')].filter(card => card.offsetParent)
    .sort((a, b) => a.offsetTop - b.offsetTop || a.offsetLeft - b.offsetLeft)
    .map(card => card.innerText.slice(0, 9)).join()"""
COMMANDS = """[...document.querySelectorAll('.chosen')].filter(line => line.offsetParent)
    .map(line => line.querySelector('code').innerText).join()"""
PICK = """document.querySelector('[name="{}"][value="{}"]').click()"""


@pytest.mark.slow("browser")  # a browser
def test_a_person_looks_around(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    report = write_report(dataset, dataset_distributions(dataset))
    with browser() as page:
        for width in (1280, 1000, 390):
            page.show(width, 844)
            page.open(f"{report.as_uri()}?{width}")  # another address, which is loaded anew
            assert page.run("document.documentElement.scrollWidth") <= width
            assert page.run("document.querySelector('.cards').offsetTop") < 844
            everything = page.run(SHOWN)
            assert everything == "000000000,000000001,000000002,000000003,000000020"
            page.run(PICK.format("layout", "plane"))
            assert page.run(SHOWN) == "000000000,000000002,000000003"
            assert page.run(COMMANDS).endswith("--out ../selected --template plane")
            page.run(PICK.format("split", "test"))
            assert page.run(SHOWN) == ""
            page.run(PICK.format("layout", ""))
            page.run(PICK.format("split", ""))
            page.run(PICK.format("order", "2"))  # most triangles
            assert sorted(page.run(SHOWN).split(",")) == sorted(everything.split(","))
            assert page.run(SHOWN) != everything and page.run(COMMANDS) == ""
            page.call("Emulation.setScriptExecutionDisabled", value=True)
            page.open(f"{report.as_uri()}?{width}&bare")
            assert page.run(SHOWN) == everything
            assert not page.run("document.querySelector('.filters').offsetParent")
            page.call("Emulation.setScriptExecutionDisabled", value=False)
            page.run("document.querySelector('.card').click()")
            page.until("document.querySelector('.zoom')")
            page.run("document.querySelector('.zoom').click()")
            assert page.run("document.querySelector('.zoom + img').width") >= min(width, 800)
