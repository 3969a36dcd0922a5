"""What the name of an outcome says of this stage's source."""

from pathlib import Path

from pipeline.assets.recipe import code_sha256

SOURCE = "import json\n\nfrom storage.records.asset import Asset\n\nVALUE = 1\n"


def _digest(folder: Path, source: str) -> str:
    folder.mkdir()
    (folder / "a.py").write_text(source)
    return code_sha256(folder)


def test_where_an_import_comes_from_does_not_count_and_what_is_done_does(tmp_path: Path) -> None:
    """So a wheel, whose packages stand elsewhere, shares the store with a checkout."""
    here = _digest(tmp_path / "here", SOURCE)
    several = "from trilight.storage.asset import (\n    Asset,\n    decode_asset,\n)"
    moved = SOURCE.replace("from storage.records.asset import Asset", several)
    assert _digest(tmp_path / "moved", moved) == here
    assert _digest(tmp_path / "changed", SOURCE.replace("1", "2")) != here
