"""A dataset preset of your own: a function that returns the full settings of a dataset.

    trilight generate dataset_preset.py:sunsets --out data/sunsets

The manifest keeps the settings in full and the sha256 of this file: going on with a dataset after
the file has changed is refused, since its other scenes would not be of the same kind.
"""

import dataclasses

from trilight.extend import DatasetPreset, DatasetSettings, LightSettings, preset_settings


def sunsets() -> DatasetPreset:
    """Return the smoke preset with one or two coloured lights, far apart from each other."""
    base: DatasetSettings = preset_settings("smoke")
    lights: LightSettings = dataclasses.replace(
        base.scenes.lights, count=(1, 2), coloured_share=1.0
    )
    settings = dataclasses.replace(
        base,
        build="sunsets",  # a name of its own: it stands in the manifest and on the card
        scenes=dataclasses.replace(base.scenes, lights=lights, num_views=2),
        renders=dataclasses.replace(base.renders, resolution=128, noise_floor_db=38.0),
    )
    # a function may return the settings alone; this says how many scenes there are by default
    return DatasetPreset(settings=lambda: settings, num_scenes=32)
