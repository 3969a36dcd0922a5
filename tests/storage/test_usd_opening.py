"""USD files of strangers: what is outside, circular, too large or broken is one clear line."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from storage.errors import TrilightError
from storage.usd import opening
from storage.usd.diagnostics import quietly
from storage.usd.export import write_usd
from storage.usd.opening import OpenedUsd
from tests.scenes_by_hand import tiny_scene

HEAD = "#usda 1.0\n"


def prims_of(path: Path) -> list[str]:
    stage = quietly(path, OpenedUsd(path).compose)
    return [str(prim.GetPath()) for prim in stage.Traverse()]


def bomb() -> str:
    """Twelve levels of ten references each: 10^12 prims in 2 kB."""
    levels = "".join(
        f'def "L{i}" {{'
        + "".join(f'def "c{j}" (references = </L{i + 1}>) {{}}\n' for j in range(10))
        + "}\n"
        for i in range(12)
    )
    return f'{HEAD}{levels}def "L12" {{}}'


def chain(length: int) -> str:
    arcs = "".join(f'def "L{i}" (references = </L{i + 1}>) {{}}\n' for i in range(length))
    return f'{HEAD}{arcs}def "L{length}" {{}}'


VARIANT = (
    'def "A" (variantSets = "v") {\nvariantSet "v" = {\n"x" (references = @../x.usda@) {}\n}\n}'
)
CLIPS = 'def "A" (clips = {dictionary default = {asset[] assetPaths = [@/x.usda@]}}) {}'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('def "A" (references = @https://x.y/z.usda@</A>) {}', "nothing is fetched"),
        ('def "A" (references = @s3://x/z.usda@</A>) {}', "nothing is fetched"),
        ('def "A" (references = @/etc/x.usda@</A>) {}', "outside of its folder"),
        ('def "A" (payload = @../x.usda@</A>) {}', "outside of its folder"),
        ('def "A" (references = @./a/../../x.usda@</A>) {}', "outside of its folder"),
        (VARIANT, "outside of its folder"),
        ('def "A" (references = </B>) {}\ndef "B" (references = </A>) {}', "in a circle"),
        ('def "A" (references = @./file.usda@</A>) {}', "in a circle"),
        ('def "A" {\ndef "B" (inherits = </A>) {}\n}', "in a circle"),
        (CLIPS, "value clips"),
        ('def "A" {', "not readable as USD"),
        ("\0\1\2", "not readable as USD"),
    ],
)
def test_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "x.usda").write_text(HEAD)  # it is there, and must not be read
    folder = tmp_path / "inner"
    folder.mkdir()
    (folder / "file.usda").write_text(HEAD + text)
    with pytest.raises(TrilightError, match=message) as caught:
        prims_of(folder / "file.usda")
    assert "\n" not in str(caught.value) and str(tmp_path) not in str(caught.value)
    assert str(caught.value).startswith("file.usda: ")


def test_layers_in_a_circle(tmp_path: Path) -> None:
    for one, other in ("ab", "ba"):
        (tmp_path / f"{one}.usda").write_text(f"#usda 1.0\n(subLayers = [@./{other}.usda@])\n")
    with pytest.raises(TrilightError, match="name one another in a circle"):
        prims_of(tmp_path / "a.usda")


def test_a_link_that_leads_outside(tmp_path: Path) -> None:
    (tmp_path / "secret.usda").write_text(f'{HEAD}def "A" {{}}')
    folder = tmp_path / "inner"
    folder.mkdir()
    (folder / "link.usda").symlink_to(tmp_path / "secret.usda")
    (folder / "a.usda").write_text(f'{HEAD}def "A" (references = @./link.usda@</A>) {{}}')
    with pytest.raises(TrilightError, match="outside of its folder"):
        prims_of(folder / "a.usda")
    opened = OpenedUsd(folder / "a.usda", tmp_path)  # allowed: the user names the folder
    stage = opened.compose()
    assert len(list(stage.Traverse())) == 1


def test_the_working_directory_is_no_place_to_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lib.usda").write_text(f'{HEAD}def "A" {{}}')
    folder = tmp_path / "inner"
    folder.mkdir()
    (folder / "a.usda").write_text(f'{HEAD}def "A" (references = @lib.usda@</A>) {{}}')
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TrilightError, match="outside of its folder"):
        prims_of(folder / "a.usda")


def test_what_references_multiply_is_counted_before_it_is_made(tmp_path: Path) -> None:
    (tmp_path / "bomb.usda").write_text(bomb())
    with pytest.raises(TrilightError, match=r"would make \d{13} prims"):
        prims_of(tmp_path / "bomb.usda")


def test_the_count_is_never_below_what_composition_makes(tmp_path: Path) -> None:
    (tmp_path / "b.usda").write_text(
        f'{HEAD}def "P" {{\ndef "a" {{}}\ndef "b" {{}}\n}}\n'
        'def "Q" (references = </P>) {\ndef "c" (references = </P>) {}\n}\n'
        'def "R" (inherits = </Q>) {\nover "c" {\ndef "d" {}\n}\n}\n'
    )
    opened = OpenedUsd(tmp_path / "b.usda")
    counted = opening._Walk(opened).size(opened.root, "/", 0)
    stage = opened.compose()
    made = len(list(stage.Traverse()))
    assert made == 16
    assert made <= counted <= 2 * made


def test_depth(tmp_path: Path) -> None:
    (tmp_path / "chain.usda").write_text(chain(opening.MAX_DEPTH + 1))
    with pytest.raises(TrilightError, match="deep"):
        prims_of(tmp_path / "chain.usda")


def test_what_is_missing_is_noted(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text(f'{HEAD}def "A" (references = @./no.usda@</A>) {{}}')
    opened = OpenedUsd(tmp_path / "a.usda")
    quietly(opened.path, opened.compose)
    assert opened.lost == ["file './no.usda' is missing"]


def package(path: Path, change: Callable[[zipfile.ZipFile], None]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        change(archive)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda archive: archive.writestr("a.usda", HEAD * 1000, zipfile.ZIP_DEFLATED),
            "is compressed",
        ),
        (lambda archive: archive.writestr("../a.usda", HEAD), "leads outside"),
        (lambda archive: None, "0 members"),
    ],
)
def test_packages(tmp_path: Path, change: Callable[[zipfile.ZipFile], None], message: str) -> None:
    package(tmp_path / "a.usdz", change)
    with pytest.raises(TrilightError, match=message):
        OpenedUsd(tmp_path / "a.usdz")


def test_sizes_are_looked_at_first(tmp_path: Path) -> None:
    with (tmp_path / "a.usdc").open("wb") as stream:
        stream.truncate(opening.MAX_FILE_BYTES + 1)  # a hole: it takes no room
    with pytest.raises(TrilightError, match="expected a file of 1 to"):
        OpenedUsd(tmp_path / "a.usdc")
    (tmp_path / "b.usda").touch()
    with pytest.raises(TrilightError, match="0 bytes"):
        OpenedUsd(tmp_path / "b.usda")
    with pytest.raises(TrilightError, match="cannot be read"):
        OpenedUsd(tmp_path / "absent.usda")


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_cut_files(tmp_path: Path, suffix: str) -> None:
    whole = tmp_path / f"a{suffix}"
    write_usd(whole, tiny_scene())
    data = whole.read_bytes()
    for kept in np.linspace(1, len(data) - 30, 9).astype(int):
        cut = tmp_path / f"cut{kept}{suffix}"
        cut.write_bytes(data[:kept])
        with pytest.raises(TrilightError, match="^cut"):
            OpenedUsd(cut)
