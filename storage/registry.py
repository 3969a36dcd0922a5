"""`Registry`: a table of things that have a name, ours first, to which extensions may add.

Each kind of thing that can be added from outside has one such table beside its own type: templates,
families, presets, sizes of networks, object sources, decimations, metrics, scene formats and
executors. Listing the table shows all of them.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from storage.errors import OF_EXTENSION, TrilightError, expected_one_of
from storage.extensions import Decided, Extension, is_reference, load_reference, loading, short_name

Entry = TypeVar("Entry")

_NAME = re.compile(r"[\w.+:\-]{1,64}")


class Registry(Mapping[str, Entry], Generic[Entry]):
    """Entries by name, in the order in which they came."""

    def __init__(
        self,
        what: str,
        kind: Any,
        entries: Mapping[str, Entry],
        *,
        decides: tuple[Decided, ...] = (),
        aliases: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Begin a table.

        Args:
            what: one entry is called in messages, such as `template`.
            kind: type of every entry, as isinstance takes it.
            entries: our own.
            decides: what depends on its entries. Extensions that add to a table that decides
                nothing are not recorded: they change how something is done, not what it means.
            aliases: further names of our own entries; no list shows them.
        """
        self.what = what
        self._kind = kind
        self._decides = frozenset(decides)
        self._entries = dict(entries)
        self._aliases = aliases
        self._origins: dict[str, Extension] = {}

    def register(self, name: str, entry: Entry) -> None:
        """Add an entry; call this in a file that `--extend` names.

        It raises TrilightError where the name is taken or no word, the entry is of another kind, or
        something is made of it and no file is being loaded, so that nothing could record it.
        """
        extension = loading()
        stated_name = getattr(entry, "name", name)
        refusal = ""
        if extension is None and self._decides:
            refusal = (
                " is registered outside an extension, so what is made with it could not record its "
                "origin; expected the call in a file that --extend names, or that "
                "storage.extensions.load_extension loads."
            )
        elif not isinstance(name, str) or not _NAME.fullmatch(name):
            refusal = ": not a valid name; expected up to 64 letters, digits and _ . + : -"
        elif name in self:
            origin = self._origins.get(name)
            owner = origin.name if origin else "Trilight itself"
            refusal = f" is taken by {owner}; expected another name."
        elif not isinstance(entry, self._kind):
            expected_type = getattr(self._kind, "__name__", str(self._kind))
            refusal = f" is a {type(entry).__name__}; expected a {expected_type}."
        elif stated_name != name:
            refusal = f" has the name {stated_name!r} itself; expected the same."
        if refusal:
            raise TrilightError(f"{self.what} {name!r}{refusal}")
        self._entries[name] = entry
        if extension:
            self._origins[name] = extension
            extension.decides.update(self._decides)
            extension.undo.append(lambda: (self._entries.pop(name), self._origins.pop(name)))

    def resolve(self, reference: str, as_entry: Callable[[Any], Entry]) -> str:
        """Return the name of an entry that was typed on a command line.

        FILE.py:FUNCTION runs a file of their own and registers what the function returns as
        `FILE.py:FUNCTION` without the folder.

        Args:
            reference: a name, which may be unknown, or FILE.py:FUNCTION.
            as_entry: makes an entry of what the function returned, or raises TrilightError.

        Raises:
            TrilightError: the file cannot be loaded (storage.extensions), or does not define it.
        """
        if not is_reference(reference):
            return reference
        name = short_name(reference)
        with load_reference(reference) as value:
            if name not in self._entries:
                self.register(name, as_entry(value))
        return name

    def find(self, name: str) -> Entry:
        """Return an entry; raises TrilightError for a name that is not registered."""
        if name not in self:
            known = [*self._aliases, *self._entries]
            raise TrilightError(
                f"{self.what} {name!r} is unknown; {expected_one_of(name, known)}, or "
                f"{OF_EXTENSION}."
            )
        return self[name]

    def is_ours(self, name: str) -> bool:
        """Return whether an entry comes with Trilight, and from no extension."""
        return name in self and name not in self._origins

    def __getitem__(self, name: str) -> Entry:
        return self._entries[self._aliases.get(name, name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)
