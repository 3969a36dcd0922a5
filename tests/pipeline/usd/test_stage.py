"""USD files of strangers: what is outside, circular, too large or broken is one clear line."""

import itertools
import os
import socket
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.exchange.usd.write import write_usd
from pipeline.usd import stage as opening
from pipeline.usd.stage import OpenedUsd, quietly
from pipeline.usd.texture_nodes import asset_bytes
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_scene

HEAD = "#usda 1.0\n"


def prims_of(path: Path) -> list[str]:
    stage = quietly(path, OpenedUsd(path).compose)
    return [str(prim.GetPath()) for prim in stage.Traverse()]


VARIANT = (
    'def "A" (variantSets = "v") {\nvariantSet "v" = {\n"x" (references = @../x.usda@) {}\n}\n}'
)
CLIPS = 'def "A" (clips = {dictionary default = {asset[] assetPaths = [@/x.usda@]}}) {}'


@for_each(
    "text, message",
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


OPENERS = {
    "reference": 'def "x" (references = @F@</A>) {}',
    "prepended": 'def "x" (prepend references = @F@</A>) {}',
    "appended": 'def "x" (append references = @F@</A>) {}',
    "added": 'def "x" (add references = @F@</A>) {}',
    "payload": 'def "x" (payload = @F@</A>) {}',
    "of an over": 'over "x" (references = @F@</A>) {}',
    "inactive": 'def "x" (active = false\nreferences = @F@</A>) {}',
    "in a variant": 'def "x" (variantSets = "v") {\nvariantSet "v" = {\n"a" {\n'
    'def "y" (payload = @F@</A>) {}\n}\n}\n}',
    "of an ancestor": 'def "B" (references = @F@</A>) {\ndef "C" {}\n}\n'
    'def "x" (references = </B/C>) {}',
}
"""Every way in which a layer names a file for composition; F is the file."""


@for_each(
    "way, place", itertools.product(OPENERS, ["root", "sublayer", "referenced by an ancestor"])
)
def test_no_way_leads_out(tmp_path: Path, way: str, place: str) -> None:
    """In the root layer, or in a layer of which only the child of a prim is referenced."""
    (tmp_path / "secret.usda").write_text(f'{HEAD}def "A" {{\ndef "C" {{}}\n}}')
    folder = tmp_path / "inner"
    folder.mkdir()
    out = HEAD + OPENERS[way].replace("F", str(tmp_path / "secret.usda"))
    (folder / "lib.usda").write_text(out)
    root = {
        "root": out,
        "sublayer": "#usda 1.0\n(subLayers = [@./lib.usda@])\n",
        "referenced by an ancestor": f'{HEAD}def "A" (references = @./lib.usda@</x/C>) {{}}',
    }[place]
    (folder / "a.usda").write_text(root)
    with pytest.raises(TrilightError, match="which is outside of its folder"):
        prims_of(folder / "a.usda")


@pytest.mark.parametrize(
    "text",
    [
        '(expressionVariables = {string X = "../secret"}\nsubLayers = [@`"${X}.usda"`@])',
        '(expressionVariables = {string X = "../secret"})\n'
        'def "x" (references = @`"${X}.usda"`@</A>) {}',
        'def "x" (payload = @`"../secret.usda"`@</A>) {}',
    ],
)
def test_variable_expressions_name_no_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    (tmp_path / "secret.usda").write_text(f'{HEAD}def "A" {{}}')
    folder = tmp_path / "inner"
    folder.mkdir()
    monkeypatch.chdir(folder)  # where a person who converts a file often is
    (folder / "a.usda").write_text(f"#usda 1.0\n{text}\n")
    with pytest.raises(TrilightError, match="a variable expression; expected a name"):
        prims_of(folder / "a.usda")


def test_a_package_leads_out_no_more_than_a_folder(tmp_path: Path) -> None:
    (tmp_path / "secret.usda").write_text(f'{HEAD}def "B" {{}}')
    folder = tmp_path / "inner"
    folder.mkdir()
    with zipfile.ZipFile(folder / "a.usdz", "w") as archive:
        archive.writestr("s.usda", f'{HEAD}def "x" (references = @./lib.usda@</A/L>) {{}}')
        outer = f"references = @{tmp_path / 'secret.usda'}@</B>"
        archive.writestr("lib.usda", f'{HEAD}def "A" ({outer}) {{\ndef "L" {{}}\n}}')
    with pytest.raises(TrilightError, match="which is outside of its folder"):
        prims_of(folder / "a.usdz")


@pytest.mark.parametrize("packed", [False, True])
def test_brackets_in_the_name_of_a_folder_are_no_archive(tmp_path: Path, packed: bool) -> None:
    folder = tmp_path / "chairs [old]"
    folder.mkdir()
    layers = {
        "s.usda": f'{HEAD}def "x" (references = @./lib.usda@</A>) {{}}',
        "lib.usda": f'{HEAD}def "A" {{\ndef "L" {{}}\n}}',
    }
    if packed:
        with zipfile.ZipFile(folder / "s.usdz", "w") as archive:
            for name, text in layers.items():
                archive.writestr(name, text)
        assert asset_bytes(f"{folder}/s.usdz[lib.usda]", 100) == layers["lib.usda"].encode()
    else:
        for name, text in layers.items():
            (folder / name).write_text(text)
        assert asset_bytes(f"{folder}/lib.usda", 100) == layers["lib.usda"].encode()
    opened = OpenedUsd(folder / ("s.usdz" if packed else "s.usda"))
    stage = quietly(opened.path, opened.compose)
    assert [str(prim.GetPath()) for prim in stage.Traverse()] == ["/x", "/x/L"]
    assert opened.files == [opened.path, *([] if packed else [folder / "lib.usda"])]


def test_arguments_of_a_file_format_hide_no_layer(tmp_path: Path) -> None:
    (tmp_path / "lib.usda").write_text(f'{HEAD}def "A" {{}}')
    arc = "@./lib.usda:SDF_FORMAT_ARGS:x=1@</A>"
    (tmp_path / "a.usda").write_text(f'{HEAD}def "A" (references = {arc}) {{}}')
    with pytest.raises(TrilightError, match="with arguments for its file format"):
        prims_of(tmp_path / "a.usda")


@pytest.mark.parametrize("kind", ["fifo", "socket", "folder"])
def test_what_is_no_plain_file_is_not_opened(tmp_path: Path, kind: str) -> None:
    odd = tmp_path / "odd.usda"
    if kind == "fifo":
        os.mkfifo(odd)
    elif kind == "folder":
        odd.mkdir()
    else:
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(str(odd))
    (tmp_path / "a.usda").write_text(f'{HEAD}def "A" (references = @./odd.usda@</A>) {{}}')
    with pytest.raises(TrilightError, match="'./odd.usda', which is no plain file"):
        prims_of(tmp_path / "a.usda")


def test_the_stage_is_compared_with_the_folder_at_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second lock, should USD learn a way to name files that its own list of names lacks."""
    (tmp_path / "secret.usda").write_text(f'{HEAD}def "A" {{}}')
    folder = tmp_path / "inner"
    folder.mkdir()
    (folder / "a.usda").write_text(f'{HEAD}def "A" (references = @../secret.usda@</A>) {{}}')
    monkeypatch.setattr(OpenedUsd, "_open_all", lambda self: None)
    with pytest.raises(TrilightError, match="uses 'secret.usda' of another folder"):
        prims_of(folder / "a.usda")


def test_layers_in_a_circle(tmp_path: Path) -> None:
    for one, other in ("ab", "ba"):
        (tmp_path / f"{one}.usda").write_text(f"#usda 1.0\n(subLayers = [@./{other}.usda@])\n")
    with pytest.raises(TrilightError, match="refers to itself in a circle"):
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
