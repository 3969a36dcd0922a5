"""Parser of MTL files: materials as statements, and the options of a map."""

import re
from collections.abc import Iterator, Mapping

from pipeline.foreign.text import decode_name, join_continued, plain_text, unquote_name

Fields = dict[str, str]
"""Statements of a material, by key words in lower case."""

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?=\s)"
_OPTION = re.compile(
    rf"(-o|-s|-t)((?:\s+{_NUMBER}){{1,3}})\s+|(-mm)((?:\s+{_NUMBER}){{1,2}})\s+|(-[a-z]+)\s+(\S+)\s+",
    re.IGNORECASE,
)


def read_mtl(data: bytes) -> dict[str, Fields]:
    """Return the materials of a library by name; statements before the first one are ignored."""
    materials: dict[str, Fields] = {}
    fields: Fields = {}
    for line in join_continued(plain_text(data)).split(b"\n"):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith(b"#"):
            continue
        key = decode_name(words[0]).lower()
        value = decode_name(b"".join(words[1:]))
        if key == "newmtl":
            fields = materials[unquote_name(value)] = {}
        elif value or not key.startswith("map_"):  # exporters write maps without a file
            fields[key] = value
    return materials


def split_map(text: str) -> tuple[Mapping[str, list[str]], str]:
    """Return the options of a map, in lower case, and the file that it names."""
    options: dict[str, list[str]] = {}
    while option := _OPTION.match(text):
        name, value = [group for group in option.groups() if group is not None]
        options[name.lower()] = value.split()
        text = text[option.end() :]
    return options, unquote_name(text.strip())


def list_pictures(data: bytes, keys: set[str]) -> Iterator[str]:
    """Yield the files that the maps of a library name."""
    for fields in read_mtl(data).values():
        yield from (split_map(fields[key])[1] for key in fields if key in keys)
