"""Which file of a folder is which part of a texture, by the last word of its name."""

import re
from collections.abc import Mapping
from pathlib import Path

_WORDS: Mapping[str, str] = {
    "base": r"base[-_ ]?colou?r|albedo|diffuse|diff|colou?r|col",
    "specular": r"specular|spec",
    "roughness": r"roughness|rough",
    "metallic": r"metallic|metalness|metal",
    "normal": r"normal(?:[-_ ]?(?:gl|dx))?|nor(?:[-_ ]?(?:gl|dx))?|nrm|bump",
    "height": r"height|displacement|disp",
    "occlusion": r"ambient[-_ ]?occlusion|ao|arm|orm",
    "opacity": r"opacity|alpha|mask",
    "gloss": r"gloss|glossiness",
    "emission": r"emission|emissive",
}
"""Last words of names by the part that they stand for: those of the large libraries."""

READ = ("base", "specular", "roughness", "metallic")
"""Parts that a texture is made of."""

NO_TEXTURE = tuple(part for part in _WORDS if part not in READ)
"""Parts that no material here has."""

_NAME = re.compile(
    "(?i)(?P<set>.+)[-_. ](?:"
    + "|".join(f"(?P<{part}>{words})" for part, words in _WORDS.items())
    + r")(?P<size>[-_. ]\d+k)?"
)


def named_part(stem: str) -> tuple[str, str]:
    """Return the name of the set that a file belongs to, and its part; a bare name is a base.

    `oak_floor_rough_4k` is part "roughness" of the set `oak_floor_4k`.

    Args:
        stem: the name without its suffix, perhaps with folders before it.
    """
    folder, slash, name = stem.rpartition("/")
    match = _NAME.fullmatch(name)
    if match is None:
        return stem, "base"
    part = next(part for part in _WORDS if match[part])
    return f"{folder}{slash}{match['set']}{match['size'] or ''}", part


PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".tga")
"""Suffixes of pictures, in lower case."""


def sets_of(folder: Path) -> dict[str, dict[str, Path]]:
    """Return the pictures of a folder by set and part; of two of one part, the first by name."""
    found: dict[str, dict[str, Path]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in PICTURES and not path.name.startswith("."):
            name, part = named_part(path.stem)
            found.setdefault(name, {}).setdefault(part, path)
    return found
