"""The command that `trilight assets` prints as its next step."""

from pathlib import Path

from infra.cli.assets_next import generate_from_meshes
from storage.digests import sha256_hex


def test_objects_in_all_three_splits_need_no_option() -> None:
    digests = [sha256_hex(str(number).encode()) for number in range(40)]
    words = generate_from_meshes(digests, Path("meshes"), ())
    assert words == ["generate", "smoke", "--objects", "meshes", "--out", "meshes-smoke"]


def test_objects_of_one_split_limit_the_scenes_to_that_split() -> None:
    training, testing = sha256_hex(b"0"), sha256_hex(b"8")
    assert generate_from_meshes([training], Path("meshes"), ())[-2:] == ["--scenes", "8"]
    words = generate_from_meshes([testing], Path("meshes"), ())
    assert words[-2:] == ["--set", "splits.one_split=true"]
