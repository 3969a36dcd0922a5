"""Textures and skies in the report, on the card and on the page of a scene."""

import base64
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.documents import report
from pipeline.documents.card import encode_card
from pipeline.documents.distributions import Distributions, dataset_distributions
from pipeline.documents.report import write_report
from pipeline.documents.report_maps import maps_in_words, maps_section
from pipeline.documents.rights import rights_of
from pipeline.documents.scene_maps import maps_section as maps_of_scene
from storage.dataset.dataset import Dataset
from storage.records.texture import MapSource, Texture
from tests.pipeline.documents.dataset_by_hand import five_scenes, sample, write_dataset
from tests.pipeline.documents.pages_read import HARM, read, text_of
from tests.scenes_by_hand import tiny_scene
from tests.textured_by_hand import sky, textured_scene


@pytest.fixture(scope="module", autouse=True)
def figures_of_maps_alone() -> Iterator[None]:
    """The others take seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "_SECTIONS", {"maps": report._SECTIONS["maps"]})
        yield


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A textured scene below a seen sky, a textured one, and a plain one, with their report."""
    dusk = sky(radiance_rgb=np.full((4, 8, 3), 0.25, np.float32), is_seen=True)
    scenes = [textured_scene(environment=dusk), textured_scene(), tiny_scene()]
    shards = {"train-000000.tar": [sample(key, scene) for key, scene in enumerate(scenes)]}
    dataset = write_dataset(tmp_path_factory.mktemp("maps"), shards)
    write_report(dataset, dataset_distributions(dataset))
    return dataset


def test_the_report_counts_maps(dataset: Dataset) -> None:
    page = read(dataset.folder.report.read_bytes())
    text = text_of(page)
    assert "scenes textured 2 66.7% scenes below a sky 1 33.3%" in text
    assert "objects textured 0 0.0% floors and walls textured 2 66.7%" in text
    assert "texture colours 0 2 texture roughness 2" in text and "sky sky 0 1" in text
    assert "mean radiance of a sky 1 0.250 0.250 0.250 0.250" in text
    assert "#maps" in page.links


def test_a_plain_dataset_has_no_such_section(tmp_path: Path) -> None:
    found = dataset_distributions(plain := five_scenes(tmp_path))
    assert (maps_section(found), maps_in_words(found)) == ("", {})
    assert "#maps" not in read(write_report(plain, found).read_bytes()).links


def test_the_card_says_how_many(dataset: Dataset) -> None:
    found: Distributions = dataset_distributions(dataset)
    card = encode_card(dataset.folder, dataset.manifest, found, rights_of(found.objects)).decode()
    assert "2 of 3 scenes, 4 maps of 2 families, 2 to 6 texels wide" in card
    assert "1 of 3 scenes, 1 families, mean radiance 0.25; half of the light" in card


def test_a_scene_shows_its_maps(dataset: Dataset) -> None:
    text = text_of(read((dataset.folder.report_pages / "000000000.html").read_bytes()))
    assert "colours 0 (diffuse) roughness sky 0 (environment, seen)" in text
    assert "sky 0 (environment, seen): mean radiance 0.25, brightest texel 1 times that" in text
    plain = text_of(read((dataset.folder.report_pages / "000000002.html").read_bytes()))
    assert "Textures and environment" not in plain


def test_a_texture_is_shown_as_it_lies() -> None:
    """Its row 0 is at the bottom; names are text. A sun and all else of a sky are seen."""
    texels = np.zeros((2, 2, 3), np.uint8)
    texels[0, 1] = [200, 100, 50]
    texture = Texture(texels=texels, is_srgb=True, source=MapSource(name=HARM))
    number = Texture(texels=np.full((1, 1, 1), 128, np.uint8))
    found = read(
        "".join(maps_of_scene(textured_scene(0, texture, number, environment=sky()))).encode()
    )
    pictures = [_pixels(link) for link in found.links if link.startswith("data:")]
    assert pictures[0].tolist() == [[[0] * 3] * 2, [[0] * 3, [200, 100, 50]]]
    assert pictures[2].shape == (112, 224, 3) and pictures[2].max() == 255
    assert "".join(found.text).count(HARM) == 2


def _pixels(link: str) -> np.ndarray:
    data = base64.b64decode(link.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)))
