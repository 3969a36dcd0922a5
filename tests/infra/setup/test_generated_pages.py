"""Pages of the reference that are made when the site is built."""

from infra.setup.generated_pages import PAGES
from pipeline.shards.expression import TEXTS, condition, kind_of
from storage.records.passes.declared import MOTION, declared_passes
from storage.records.quantities import QUANTITIES
from tests.for_each import case


def test_every_page_is_made() -> None:
    for name, page in PAGES.items():
        with case(name):
            assert page().startswith("# ") and "\n| --- |" in page()


def test_the_page_of_passes_names_every_pass() -> None:
    page = PAGES["passes"]()
    for each in declared_passes():
        (row,) = [line for line in page.split("\n") if line.startswith(f"| `{each.name}` |")]
        assert f"| {each.means} |" in row
        assert each.name == MOTION or f"`{each.exr_channels[0]}`" in row


def test_the_page_of_quantities_names_what_a_condition_can_ask() -> None:
    page = PAGES["quantities"]()
    for name in (*QUANTITIES, *TEXTS):
        assert kind_of(name) is not None
        assert f"| `{name}` |" in page
    shown = [line.split("'")[1] for line in page.splitlines() if "--where" in line]
    assert len(shown) == 3
    for text in shown:
        condition(text)
