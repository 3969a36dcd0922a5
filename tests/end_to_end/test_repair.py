"""`trilight verify --repair`: the named shards come back to the byte, the others stay."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.end_to_end.conftest import Trilight

SMALL = (
    "--scenes", "8", "--seed", "3", "--resolution", "32", "--noise-floor", "20",
    "--set", "scenes.num_views=2", "--set", "scenes.families.0.weight=2",
)  # fmt: skip


@pytest.mark.slow("commands")
def test_bad_and_missing_shards_are_made_anew(
    trilight: Trilight, refused: Callable[..., str], tmp_path: Path
) -> None:
    made = trilight("generate", "smoke", "--out", "set", *SMALL)
    assert made.returncode == 0, made.stderr
    root = tmp_path / "set"
    names = sorted(path.name for path in root.glob("*.tar"))
    assert len(names) == 2
    whole = {name: (root / name).read_bytes() for name in names}
    manifest = json.loads((root / "manifest.json").read_text())
    times = {name: (root / name).stat().st_mtime_ns for name in names}

    damaged = bytearray(whole[names[1]])
    damaged[len(damaged) // 2] ^= 1
    (root / names[1]).write_bytes(damaged)
    found = trilight("verify", "set", "--json")
    assert found.returncode == 1
    assert json.loads(found.stdout)["bad_shards"] == [names[1]]

    repaired = trilight("verify", "set", "--repair")
    assert repaired.returncode == 0, repaired.stdout + repaired.stderr
    assert {name: (root / name).read_bytes() for name in names} == whole
    assert json.loads((root / "manifest.json").read_text()) == manifest
    assert (root / names[0]).stat().st_mtime_ns == times[names[0]]
    assert not list(root.glob("*.bad"))
    assert "cannot be read" in refused("verify", "http://127.0.0.1:1/set", "--repair")
