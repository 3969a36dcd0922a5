"""Whom a begun dataset binds; a user's own files are recorded, refused, never imported."""

import dataclasses
import json
import re
from contextlib import closing
from pathlib import Path

import pytest
from prefect.exceptions import ParameterTypeError

from infra.repair import repair
from pipeline.exchange.reader import LIMITS
from pipeline.executors.threads import ThreadRunner
from pipeline.flows.prefect_flows import generate_scenes
from pipeline.generation.derive_dataset import _extensions
from pipeline.generation.freeze_objects import ObjectLock
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.pipeline import make_dataset, make_task, prepare_dataset
from pipeline.generation.scene_origins import AcceptedObjects
from pipeline.isolation import NO_FILES, IsolatedChild, call_with_retries, reach
from pipeline.presets.registry import DATASET_PRESETS, preset_settings, resolve_dataset_preset
from pipeline.shards.pack_shards import PublishedShards
from scene_templates.families import FAMILIES
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest, write_manifest
from storage.dataset.progress import read_asked, write_asked
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError, removal_message
from storage.extensions import load_extension, mistake_in_extension
from tests.command_line import trilight
from tests.conftest import ROOT
from tests.extensions_kit import EXAMPLES, loaded, parts_of, room_for_extensions, written
from tests.for_each import case, for_each
from tests.pipeline.documents.dataset_by_hand import edit_manifest
from tests.pipeline.generation.test_dataset_writer import begin_tiny, make_tiny_shard
from tests.pipeline.generation.tiny_scenes_kit import (
    Undocumented,
    shard_job,
    tiny_order,
    without_rendering,
)

TEMPLATE = EXAMPLES / "template.py"
TRAP = "from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\n"
"""Leaves a mark when it is imported."""


def test_the_manifest_records_what_had_part_in_a_dataset_and_what_is_left_out_is_asked_for(
    tmp_path: Path,
) -> None:
    with loaded(TEMPLATE) as extension:
        begin_tiny(tmp_path)
    manifest = read_manifest(tmp_path / "manifest.json")
    assert manifest.extensions == {"template.py": extension.sha256}
    assert str(EXAMPLES) not in (tmp_path / "manifest.json").read_text()
    with pytest.raises(TrilightError, match=r"begun with the extension template\.py, which is not"):
        begin_tiny(tmp_path)
    other = written(tmp_path, TEMPLATE.read_text() + "\n# changed\n", "template.py")
    changed = r"another extension template\.py: its sha256 was"
    with loaded(other), pytest.raises(TrilightError, match=changed):
        begin_tiny(tmp_path)
    with loaded(TEMPLATE):
        begin_tiny(tmp_path)
    with loaded(EXAMPLES / "executor.py"):  # changes how a dataset is made, and nothing of it
        begin_tiny(tmp_path / "plain")
    assert "extensions" not in json.loads((tmp_path / "plain" / "manifest.json").read_text())
    added = r"begun without the extension template\.py; leave"
    with loaded(TEMPLATE), pytest.raises(TrilightError, match=added):
        begin_tiny(tmp_path / "plain")
    job = shard_job(tmp_path, extensions={"template.py": "1" * 64})
    with pytest.raises(TrilightError, match=r"this worker: .* add --extend template\.py"):
        make_task(job, ())
    # By commands an extension is asked for by its file where there are objects; else as possible.
    words = ["generate", "smoke", "--set", "scenes.families=corridor", "--out", str(tmp_path)]
    said = trilight(words).mistake
    assert "setting 'scenes.families' is 'corridor'" in said
    assert "alone, an extension's by --extend FILE, or one of its settings by name" in said
    begun = dataclasses.replace(manifest, objects_lock_sha256="0" * 64)
    write_manifest(tmp_path / "manifest.json", begun)
    said = "begun with the extension template.py, which is not given; add --extend template.py"
    assert said in trilight(words).mistake
    assert "or an extension's by --extend FILE" in trilight(["generate", "corridor"]).mistake


def test_children_know_what_is_registered() -> None:
    """Also those of a fork server that was started before."""
    with closing(IsolatedChild(limits=LIMITS, confined_to=reach([ROOT / "tests"]))) as child:
        with pytest.raises(TrilightError, match="template 'corridor' is unknown"):
            child.call(parts_of, "corridor")
        child.retire()
        with loaded(TEMPLATE):
            assert child.call(parts_of, "corridor") == ("floor", "wall1", "wall2")
            child.retire()


BUG = """
from trilight.extend import Sector, Template

def sector(high=60):
    return Sector(azimuth_deg=0, half_width_deg=9, elevation_deg=(3, high))

def parts_of(name):
    return {}[name]
"""
"""An extension with a bug in what is called later."""


def test_a_bug_in_an_extension_is_its_authors_and_stops_at_once(tmp_path: Path) -> None:
    """In a child too: it is neither tried again nor taken for a failure of the environment."""
    child = IsolatedChild(limits=LIMITS, confined_to=NO_FILES)
    with room_for_extensions():
        bug = load_extension(written(tmp_path, BUG)).module.parts_of
        said = r"^extension own\.py, line 8: KeyError: 'floor'\.$"
        with pytest.raises(TrilightError, match=said):
            call_with_retries(child, bug, "floor")
        child.close()
        with pytest.raises(KeyError) as caught:
            bug("floor")
        assert re.match(said, str(mistake_in_extension(caught.value)))
    with pytest.raises(ZeroDivisionError) as other:
        divmod(1, 0)
    assert mistake_in_extension(other.value) is None


def test_a_template_is_checked_when_it_is_made(tmp_path: Path) -> None:
    first = "expected none, or floor first"
    for changed, said in (
        ('parts=("floor", "wall9")', f"('floor', 'wall9'); {first}, then any of floor"),
        ('parts=("wall0", "floor")', f"('wall0', 'floor'); {first}"),
        ('parts=("floor", "wall0", "wall0")', f"'wall0'); {first}"),
        ('parts=("floor",), lights=sector(99)', "elevation_deg is (3, 99); expected two from -90"),
        ('parts=("floor",), lights=sector(2)', "(3, 2); expected two from -90 to 90, the lower"),
    ):
        text = f"Template(**dict(name='t', cameras=sector(), lights=sector()) | dict({changed}))"
        where = rf"^extension own\.py, line \d+: .*{re.escape(said)}"
        with case(changed), room_for_extensions(), pytest.raises(TrilightError, match=where):
            load_extension(written(tmp_path, f"{BUG}\n{text}\n"))


@for_each("extended", [{}, {"trap.py": "0" * 64}])
def test_neither_a_dataset_nor_a_form_ever_causes_an_import(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extended: dict[str, str]
) -> None:
    """Its preset may say FILE.py:FUNCTION, and its extensions may lie beside it."""
    folder = tmp_path / "set"
    monkeypatch.chdir(tmp_path)
    writer = begin_tiny(folder, 4)
    make_tiny_shard(writer, 0)
    for place in (tmp_path, folder):
        written(place, TRAP, "trap.py")
    manifest = dataclasses.replace(writer.manifest, build="trap.py:f", extensions=extended)
    write_manifest(folder / "manifest.json", manifest)
    verify_dataset(str(folder))
    expected = "begun with the extension trap.py" if extended else "'trap.py:f' is unknown"
    with pytest.raises(TrilightError, match=expected):
        repair(str(folder), ["train-000000.tar"], objects="builtin:", scenes_from=None)
    for words in (["generate", "trap.py:f"], ["generate", "smoke", "--extend", "trap.py"]):
        write_asked(DatasetFolder(folder), words)
        assert read_asked(open_dataset(str(folder))) is None
    with pytest.raises(ParameterTypeError, match="build"):
        generate_scenes.validate_parameters({"build": f"{tmp_path / 'trap.py'}:f"})
    assert not list(tmp_path.rglob("*.ran"))


def test_families_are_chosen_by_name() -> None:
    with loaded(EXAMPLES / "family.py"):
        for names in ("crowd", ["crowd", "plane-single"]):
            families = preset_settings("smoke", changes={"scenes.families": names}).scenes.families
            assert families[0] == FAMILIES["crowd"]()
            assert len(families) == (2 if isinstance(names, list) else 1)
        heavy = {"scenes.families": ["crowd"], "scenes.families.weight": 5.0}
        assert preset_settings("smoke", changes=heavy).scenes.families[0].weight == 5.0
    for wrong in ("crowd", ["plane-single", "crowd"], 3):
        said = r"setting 'scenes\.families' is .* of plane-single"
        with pytest.raises(TrilightError, match=said):
            preset_settings("smoke", changes={"scenes.families": wrong})
    with pytest.raises(TrilightError, match=r"families.* expected at least one"):
        preset_settings("smoke", changes={"scenes.families": []})


def test_a_wrong_family_names_file_line_and_family(tmp_path: Path) -> None:
    text = TEMPLATE.read_text()
    place = r"^extension own\.py, line \d\d, scenes\.families 'corridor': "
    for old, new, said in (
        ("object_scale=", "object_size=", "object_size does not exist; did you mean object_scale?"),
        ("(1, 2)", "(4, 3)", "num_objects is (4, 3); expected two whole numbers"),
        ('template="corridor', 'template="coridor', "'coridor' is unknown; did you mean corridor"),
        ("square_share=", "square=", "square does not exist; did you mean square_share?"),
    ):
        assert old in text
        wrong = written(tmp_path, text.replace(old, new))
        with loaded(wrong), pytest.raises(TrilightError, match=f"{place}.*{re.escape(said)}"):
            preset_settings("smoke", changes={"scenes.families": "corridor"})


def test_a_build_of_ones_own_has_a_name_of_its_own(tmp_path: Path) -> None:
    text = """
from pipeline.presets.registry import DATASET_PRESETS
from pipeline.presets.settings import DatasetPreset
from pipeline.presets.training import smoke
import dataclasses

def mine():
    return dataclasses.replace(smoke(), build="mine")

def posing():
    return smoke()

def nothing():
    pass

def wrong():
    return dataclasses.replace(smoke(), seeed=1)

DATASET_PRESETS.register("late", DatasetPreset(settings=wrong, num_scenes=1))
"""
    path = written(tmp_path, text)
    with room_for_extensions():
        name = resolve_dataset_preset(f"{path}:mine")
        assert (name, preset_settings(name).build) == ("own.py:mine", "mine")
        assert DATASET_PRESETS[name].num_scenes == 32
        with pytest.raises(TrilightError, match="build='smoke', which is one of Trilight's own"):
            preset_settings(resolve_dataset_preset(f"{path}:posing"))
        with pytest.raises(TrilightError, match=r"own\.py: it returned a NoneType; expected Data"):
            resolve_dataset_preset(f"{path}:nothing")
        late = r"^extension own\.py, line 17, dataset preset 'late'"
        with pytest.raises(TrilightError, match=late):
            preset_settings("late")
    assert name not in DATASET_PRESETS


def test_derived_sets_name_the_extensions_of_their_sources(tmp_path: Path) -> None:
    manifest = begin_tiny(tmp_path, 4).manifest
    one, other = ({"a.py": "1"}, {"a.py": "2", "b.py": "3"})
    manifests = [dataclasses.replace(manifest, extensions=each) for each in (one, other)]
    assert _extensions([manifest, *manifests]) == {"a.py": "1 2", "b.py": "3"}
    assert _extensions([manifest]) == {}


@for_each("source", ["OBJECTZ", "empty", "builtin:many", "env:TRILIGHT_NOWHERE"])
def test_a_mistyped_source_leaves_nothing_behind(
    source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(TrilightError, match="objects"):
        make_dataset(GenerateOptions(objects=source, out="set"), ThreadRunner())
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_a_dataset_is_begun_anew_until_it_has_objects_or_scenes_and_then_keeps_its_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a run leaves it that ended over its objects: other settings and fewer scenes are free."""
    without_rendering(monkeypatch)
    folder = DatasetFolder(tmp_path / "set")
    with folder.hold_shared_lock():
        begin_tiny(folder.root, 24, seed=5)
    order = tiny_order(out=str(folder.root), scenes=4, seed=7)
    run = prepare_dataset(order)  # its objects are frozen, no more
    assert run.publication.manifest.settings["seed"] == 7
    assert run.publication.manifest.num_scenes == 4
    other = dataclasses.replace(order, seed=5)
    with pytest.raises(TrilightError, match="begun with another setting: seed was 7, now 5"):
        prepare_dataset(other)
    make_dataset(order, Undocumented())
    with pytest.raises(TrilightError, match="seed was 7, now 5"):
        prepare_dataset(other)
    # One of removed settings is read and not resumed.
    dataset = open_dataset(str(tmp_path / "set"))
    settings = dict(dataset.manifest.settings)
    settings["splits"] = {**settings["splits"], "object_parts": 2}
    edit_manifest(dataset, settings=settings)
    assert verify_dataset(str(tmp_path / "set")).problems == []
    refusal = re.escape(removal_message("setting 'splits.object_parts'"))
    with pytest.raises(TrilightError, match=refusal):
        make_dataset(order, Undocumented())
    with pytest.raises(TrilightError, match=refusal):
        preset_settings("smoke", changes={"splits.object_parts": 2})


def test_the_command_is_there_while_objects_are_prepared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that status prints it; one whose objects may be refused does not replace it."""
    without_rendering(monkeypatch)
    place = str(tmp_path / "set")
    asked: list[list[str] | None] = []
    freeze = ObjectLock.accept

    def look(lock: ObjectLock) -> AcceptedObjects:
        asked.append(read_asked(open_dataset(place)))
        return freeze(lock)

    monkeypatch.setattr(ObjectLock, "accept", look)
    for objects in ("builtin:9", "builtin:8"):
        prepare_dataset(tiny_order(build="tiny", out=place, scenes=4, objects=objects))
    assert asked[0] is not None and asked[0][:4] == ["generate", "tiny", "--objects", "builtin:9"]
    assert asked[1] == asked[0]


def test_nobody_forgets_while_another_is_at_work_and_who_was_replaced_all_the_same_stops(
    tmp_path: Path,
) -> None:
    """Locks do not reach every machine: a maker whose manifest has become another's says so."""
    folder = DatasetFolder(tmp_path / "set")
    with PublishedShards(folder).hold_lock():
        mine = begin_tiny(folder.root, seed=5)
        with PublishedShards(folder).hold_lock():
            assert read_manifest(folder.manifest).settings["seed"] == 5
        folder.manifest.unlink()
        begin_tiny(folder.root, seed=7)
        with pytest.raises(TrilightError, match="another dataset has been begun here"):
            mine.lock_objects([])
