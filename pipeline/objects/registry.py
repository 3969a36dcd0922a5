"""The sources of objects by the word before their colon: what each lists, and how."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.objects.generated import generate_objects, num_builtin
from pipeline.objects.licences import require_unstated
from pipeline.objects.listing import Listing
from pipeline.objects.local.source import list_folder
from pipeline.objects.objaverse.source import list_objaverse
from pipeline.objects.remote.source import list_remote
from storage.registry import Registry
from storage.remote.url import PACKAGES, parse_url


@dataclass(frozen=True, kw_only=True)
class SourceQuery:
    """What a person asks a source for."""

    source: str
    """The source as it was written, such as `objaverse:category/chair`."""
    work_dir: Path
    """Where a source may write files that it makes."""
    licence: str | None
    """Of files that come without any statement, as the user states it."""
    allowed_licences: Sequence[str]
    """For sources that need not list what would be refused; the others are refused later."""

    @property
    def after_colon(self) -> str:
        """What the source is asked for, without its name."""
        return self.source.partition(":")[2]


@dataclass(frozen=True, kw_only=True)
class ObjectSource:
    """Where objects come from."""

    list: Callable[[SourceQuery], Listing]
    """Returns what the source holds; raises TrilightError where it is missing or malformed."""
    look: Callable[[SourceQuery], object] | None = None
    """Raises the same errors and writes nothing, where `list` would be dear."""
    states_licences: bool = True
    """Whether the licence of every object is known, so that nobody else may state one."""
    is_place: bool = False
    """Whether the name is the scheme of a URL, which may hold a secret."""

    def asked(self, asked: SourceQuery, *, only_look: bool) -> Listing | None:
        """Return what `list` does, or have a look; raises TrilightError as they do."""
        if self.states_licences:
            require_unstated(asked.licence, f"{asked.source.partition(':')[0]}:")
        if only_look and self.look:
            self.look(asked)
            return None
        return self.list(asked)


def _list_place(asked: SourceQuery) -> Listing:
    place = parse_url(asked.source, what="objects")
    if isinstance(place, Path):
        return list_folder(place, asked.licence)
    return list_remote(place, asked.licence)


PLACE = ObjectSource(list=_list_place, states_licences=False, is_place=True)
"""A folder, here or on a server; also what has no name before a colon."""

SOURCES: Registry[ObjectSource] = Registry(
    "object source",
    ObjectSource,
    {
        "builtin": ObjectSource(
            list=lambda asked: Listing(
                records=generate_objects(asked.source, asked.work_dir), failures=[]
            ),
            look=lambda asked: num_builtin(asked.source),
        ),
        "objaverse": ObjectSource(
            list=lambda asked: list_objaverse(asked.source, asked.allowed_licences)
        ),
        **dict.fromkeys(("file", *PACKAGES, "pipe", "env"), PLACE),
    },
    decides=("data",),
)
"""By the word before the colon."""


def source_of(text: str) -> ObjectSource:
    """Return what lists a source: that of the word before its colon, or else a folder."""
    name, colon, _ = text.partition(":")
    return SOURCES.get(name, PLACE) if colon else PLACE
