"""docs/reference/surfaces-and-skies.md is what the families draw."""

from infra.setup.maps_page import FILE, maps_page
from scene_templates.skies.families import OUR_SKIES
from scene_templates.surfaces.families import OUR_SURFACES


def test_the_page_is_what_is_drawn() -> None:
    page = maps_page()
    assert FILE.read_text() == page, "run `make settings`"
    for name in (*OUR_SURFACES, *OUR_SKIES):
        assert page.count(f"### `{name}`\n") == 1
    assert "| painted | true with probability 0.5 |" in page
    assert "| steel: roughness | uniform, 0.1 to 0.5 |" in page, (
        "drawn only where nothing is painted"
    )
