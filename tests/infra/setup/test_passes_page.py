"""docs/reference/passes.md is what the declared passes say."""

from infra.setup.passes_page import FILE, passes_page
from storage.records.passes.declared import MOTION, declared_passes


def test_the_page_names_every_pass() -> None:
    page = passes_page()
    assert FILE.read_text() == page, "run `make settings`"
    for each in declared_passes():
        (row,) = [line for line in page.split("\n") if line.startswith(f"| `{each.name}` |")]
        assert f"| {each.means} |" in row
        assert each.name == MOTION or f"`{each.exr_channels[0]}`" in row
