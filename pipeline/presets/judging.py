"""Dataset presets for the evaluation of networks, never training: all scenes belong to `test`.

Their pictures are stored without loss: there are few, and all figures are measured against them.
"""

import dataclasses

from pipeline.objects.generated import BENCHMARK
from pipeline.presets.frozen_v1 import JUDGING_SPLITS, SETTINGS_V1
from pipeline.presets.settings import DatasetPreset, DatasetSettings
from scene_templates.out_of_range import out_of_range_2_settings, out_of_range_settings
from storage.dataset.settings import StorageSettings

_EXACT = StorageSettings(profile="lossless", passes=())


def out_of_range() -> DatasetSettings:
    """Scenes with one axis beyond the trained range: 37 values of nine axes in four layouts."""
    return dataclasses.replace(
        SETTINGS_V1,
        build="out-of-range",
        assets=dataclasses.replace(SETTINGS_V1.assets, budgets=(3900, 2600, 1700, 1100, 700, 400)),
        scenes=out_of_range_settings(max_triangles=4096),
        # Lights of a hundredth of the area: a view is black where it is a thousand times darker.
        renders=dataclasses.replace(SETTINGS_V1.renders, max_spp=2048, min_mean_radiance=1e-5),
        splits=dataclasses.replace(JUDGING_SPLITS, scenes_per_shard=37),
        storage=_EXACT,
    )


def out_of_range_2() -> DatasetSettings:
    """`out-of-range` with twelve more values: five axes of textures and skies.

    It is another set: the first nine axes have the same distribution, and different scenes.
    """
    base = out_of_range()
    return dataclasses.replace(
        base,
        build="out-of-range-2",
        scenes=out_of_range_2_settings(max_triangles=4096),
        splits=dataclasses.replace(base.splits, scenes_per_shard=49),
    )


def benchmark_v1() -> DatasetSettings:
    """200 frozen scenes, 50 of each layout, one view each, to 48 dB or 2048 samples.

    The settings, the seed and the built-in objects are frozen: every run gives the same scenes
    (their digest is below, and in docs/reference). For the second resolution use
    `--resolution 512`.
    """
    return dataclasses.replace(
        SETTINGS_V1,
        build="benchmark-v1",
        seed=20261121,
        source=BENCHMARK,
        renders=dataclasses.replace(SETTINGS_V1.renders, noise_floor_db=48.0, max_spp=2048),
        splits=JUDGING_SPLITS,
        storage=_EXACT,
    )


PRESETS_FOR_JUDGING = {
    "out-of-range": DatasetPreset(settings=out_of_range, num_scenes=148, device="cpu"),
    "out-of-range-2": DatasetPreset(settings=out_of_range_2, num_scenes=196, device="cpu"),
    "benchmark-v1": DatasetPreset(
        settings=benchmark_v1,
        num_scenes=200,
        device="cpu",
        scene_digest="5c77fcc0c9a5cb2859a0433befce8ae15d7cd4ad6fd26b8775494fde4fd8c14f",
    ),
    "benchmark-v1-mini": DatasetPreset(
        settings=benchmark_v1,
        num_scenes=20,
        device="cpu",
        scene_digest="c2d2baa3de32b89bc0b1eca3588ffe9d841ec5881879cf97bc69340abb3ebc49",
    ),
}
"""`out-of-range` counts 37 values times four layouts, its second version 49; the mini is the
beginning of the other, and grows into it with more `--scenes`."""
