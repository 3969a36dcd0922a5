"""Names for people mean what the stored names mean, and are never stored."""

from model.open import find_network
from pipeline.generation.generate_options import GenerateOptions, generate_words
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from storage.aliases import NETWORKS, OBJECTS, PRESET_ALIASES, stored_name
from train.presets import TRAINING_PRESETS, training_preset


def test_a_name_for_people_is_the_stored_one_but_in_a_command_that_is_printed() -> None:
    assert stored_name("tiny", PRESET_ALIASES) == "smoke"
    assert stored_name("procedural:benchmark-v1", OBJECTS) == "builtin:benchmark-v1"
    for other in ("tiny2", "FOLDER/procedural", "builtin:8", "default:tokens"):
        for names in (PRESET_ALIASES, OBJECTS, NETWORKS):
            assert stored_name(other, names) == other
    assert preset_settings("tiny") == preset_settings("smoke")
    assert training_preset("tiny") == training_preset("smoke")
    assert GenerateOptions(build="tiny", objects="procedural:8").source == "builtin:8"
    assert find_network("default").path == find_network("builtin:").path
    assert "tiny" not in list(DATASET_PRESETS) and "tiny" not in list(TRAINING_PRESETS)
    assert generate_words(GenerateOptions(build="tiny"))[:2] == ["generate", "tiny"]
    assert GenerateOptions(build="tiny").place == "data/tiny"
