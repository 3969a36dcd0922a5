"""docs/reference/quantities.md is what the tables say."""

from infra.setup.quantities_page import FILE, quantities_page
from pipeline.shards.expression import TEXTS, condition, kind_of
from storage.records.quantities import QUANTITIES


def test_the_page_names_what_a_condition_can_ask() -> None:
    page = quantities_page()
    assert FILE.read_text() == page, "run `make settings`"
    for name in (*QUANTITIES, *TEXTS):
        assert kind_of(name) is not None
        assert f"| `{name}` |" in page


def test_the_conditions_of_the_page_can_be_read() -> None:
    shown = [line.split("'")[1] for line in quantities_page().splitlines() if "--where" in line]
    assert len(shown) == 3
    for text in shown:
        condition(text)
