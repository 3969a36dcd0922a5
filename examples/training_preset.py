"""A training preset of your own: a function that returns everything that decides the weights.

    trilight train training_preset.py:quick_lights --data data/smoke --out runs/lights

settings.json and every checkpoint keep the settings in full and the sha256 of this file: --resume
after the file has changed is refused. The trained network opens anywhere, without the file.
"""

import dataclasses

from trilight.extend import TrainSettings, training_preset


def quick_lights() -> TrainSettings:
    """Return a short run that is shown every scene under lights of many strengths."""
    base = training_preset("smoke")
    return dataclasses.replace(
        base,
        run="quick-lights",
        augmentation=dataclasses.replace(base.augmentation, light_scale=4.0),
        num_steps=120,
        warmup_steps=20,
        learning_rate=2e-3,
    )
