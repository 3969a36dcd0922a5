"""Names for people mean what the stored names mean, and are never stored."""

from model.open import find_network
from pipeline.builds.named import BUILDS, named_build, object_source
from pipeline.generation.dataset_order import DatasetOrder, generate_words
from storage.aliases import NETWORKS, OBJECTS, PRESETS, stored_name
from train.runs import RUNS, named_run


def test_a_name_for_people_is_the_stored_one() -> None:
    assert stored_name("tiny", PRESETS) == "smoke"
    assert stored_name("procedural:benchmark-v1", OBJECTS) == "builtin:benchmark-v1"
    for other in ("tiny2", "FOLDER/procedural", "builtin:8", "default:tokens"):
        for names in (PRESETS, OBJECTS, NETWORKS):
            assert stored_name(other, names) == other


def test_what_is_stored_keeps_its_name() -> None:
    assert named_build("tiny") == named_build("smoke")
    assert named_run("tiny") == named_run("smoke")
    assert object_source(named_build("tiny"), "procedural:8") == "builtin:8"
    assert find_network("default").path == find_network("builtin:").path
    assert "tiny" not in list(BUILDS) and "tiny" not in list(RUNS)


def test_a_command_that_is_printed_keeps_the_typed_name() -> None:
    assert generate_words(DatasetOrder(build="tiny"))[:2] == ["generate", "tiny"]
    assert DatasetOrder(build="tiny").place == "data/tiny"
