"""What the pages are made of: three.js as its authors built it, and files that find each other."""

import hashlib
import re

from infra.setup.sbom import THREE_SHA256, THREE_VERSION
from infra.viewer.static_files import STATIC

THREE = STATIC / "three"


def test_three_is_the_one_of_the_bill_of_materials() -> None:
    for name, digest in THREE_SHA256.items():
        assert hashlib.sha256((THREE / name).read_bytes()).hexdigest() == digest
    revision = THREE_VERSION.split(".")[1]
    assert f'="{revision}"' in (THREE / "three.core.min.js").read_text()
    assert "The MIT License" in (THREE / "LICENSE").read_text()


def test_every_file_that_a_page_names_is_there() -> None:
    named = 0
    for path in STATIC.iterdir():
        if path.suffix not in (".html", ".js"):
            continue
        text = path.read_text()
        for place in re.findall(r'(?:(?:src|href)="static|from "\.)/([^"]+)"', text):
            assert (STATIC / place).is_file(), (path, place)
            named += 1
    assert named > 15


def test_every_element_that_a_script_asks_for_is_in_its_page() -> None:
    scripts = {
        "scene.html": ("scene.js", "pictures.js", "edits.js", "ask.js"),
        "dataset.html": ("dataset.js", "ask.js"),
        "folder.html": ("folder.js", "ask.js"),
    }
    for page, names in scripts.items():
        there = set(re.findall(r'id="([\w-]+)"', (STATIC / page).read_text()))
        for name in names:
            text = (STATIC / name).read_text()
            asked = set(re.findall(r'(?:byId|getElementById)\("([\w-]+)"\)', text))
            assert asked and asked <= there, (page, name, asked - there)
