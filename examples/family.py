"""A family of your own: a layout that exists, filled in another way.

    trilight generate tiny --extend family.py --set 'scenes.families=["crowd", "plane-single"]'

No preset asks for all families there are: a preset of your own lists this one (see
dataset_preset.py), or `--set scenes.families` names it in place of the preset's.
"""

from trilight.extend import FAMILIES, Family, SharedRoom


def crowd() -> Family:
    """Return boxes full of small things; twice as often as families of the usual weight."""
    return Family(
        name="crowd",
        template="open_box",
        weight=2.0,
        shell=SharedRoom(tilt_deg=0.0),
        num_objects=(5, 8),
        object_scale=(0.3, 0.7),
    )


FAMILIES.register("crowd", crowd)
