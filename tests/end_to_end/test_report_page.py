"""A dataset's report in a browser: what a person filters, sorts and enlarges."""

from pathlib import Path

import pytest

from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.report import write_report
from tests.end_to_end.browser_kit import browser
from tests.pipeline.documents.dataset_by_hand import five_scenes

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
