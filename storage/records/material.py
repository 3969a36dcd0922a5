"""Columns of a material row, declared once: readers, writers, symmetries and networks iterate them.

The four published columns stand first. Another one is declared by the extension that needs it:

    COLUMNS.register("coat", MaterialColumn(name="coat", width=1, within=Within(0, 1), means="..."))

Every process that handles such scenes must load the file that does so. A scene in memory has all
the declared columns; a stored one names what it has, and lacks those that are at their default
everywhere, so that a new column changes no byte of a scene that does not use it.
"""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.registry import Registry
from storage.settings.ranges import FLOAT32_MAX, Within
from storage.typed_json import read_json

MAX_WIDTH = 64
"""Maximum width of a column."""


class UndeclaredColumn(TrilightError):
    """A file or a network has a material column that this process does not know."""


@dataclass(frozen=True, kw_only=True)
class MaterialColumn:
    """One property of a material: one number of each triangle, or a few that belong together."""

    name: str
    """Lower case letters, digits and underscores; files and networks name the column so."""
    means: str
    width: int
    within: Within
    """Range of each number; both ends are finite."""
    default: float = 0.0
    """Value of every number where a material states none."""
    is_colour: bool = False
    """True: the numbers are red, green and blue, and permuting the channels permutes them."""
    is_radiance: bool = False
    """True: the numbers are radiance, and scaling the light of a scene scales them."""
    is_log_encoded: bool = False
    """True: networks read log10(1 + x) instead of x."""
    draw: Callable[[np.random.Generator, int], NDArray] | None = field(default=None, compare=False)
    """Returns random values [M, width] for the M materials of a composed scene that do not emit;
    None: composed scenes hold the default."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_]*", self.name):
            _wrong(self.name, "the name", "lower case letters, digits and underscores")
        if not 1 <= self.width <= MAX_WIDTH:
            _wrong(self.name, f"a width of {self.width}", f"a whole number from 1 to {MAX_WIDTH}")
        if self.is_colour and self.width != 3:
            _wrong(self.name, f"a width of {self.width}", "3, since it is a color")
        if not -FLOAT32_MAX <= self.within.low <= self.within.high <= FLOAT32_MAX:
            _wrong(self.name, f"the range {self.within}", "one within the finite float32 numbers")
        if not self.within.holds(self.default):
            _wrong(self.name, f"the default {self.default}", f"a number {self.within}")
        if self.is_log_encoded and self.within.low < 0:
            _wrong(self.name, f"the range {self.within}", "one from 0, since networks read its log")


_colour = partial(MaterialColumn, width=3, is_colour=True)

_OURS = {
    column.name: column
    for column in (
        _colour(name="diffuse", means="Albedo of the diffuse lobe.", within=Within(0, 1)),
        _colour(name="specular", means="Albedo of the specular lobe.", within=Within(0, 1)),
        MaterialColumn(
            name="roughness",
            means="Roughness of the specular lobe; its GGX width is the square.",
            width=1,
            within=Within(0, 1),
        ),
        _colour(
            name="emission",
            means="Emitted radiance; a material that emits is a light.",
            within=Within(0, FLOAT32_MAX),
            is_radiance=True,
            is_log_encoded=True,
        ),
    )
}

COLUMNS: Registry[MaterialColumn] = Registry(
    "material column", MaterialColumn, _OURS, decides=("data", "weights")
)
"""The declared columns, in the order of a scene's material rows: the published ones, then others.
"""

PUBLISHED_COLUMNS = tuple(COLUMNS)
"""Names of the four columns of the published renderers, which every file and kernel knows."""


def laid_out(names: Sequence[str] | None = None) -> Iterator[tuple[MaterialColumn, slice]]:
    """Yield columns and where their numbers stand in a row that holds these, in this order.

    Args:
        names: of the columns; None: all that are declared, as in the rows of a scene.

    Raises:
        UndeclaredColumn: a name that is not declared.
    """
    start = 0
    for name in COLUMNS if names is None else names:
        column = declared_column(name)
        yield column, slice(start, start + column.width)
        start += column.width


def material_width(names: Sequence[str] | None = None) -> int:
    """Return how many numbers a row of these columns has; raises as `laid_out`."""
    return sum(column.width for column, _ in laid_out(names))


def declared_column(name: str) -> MaterialColumn:
    """Return a column by its name; raises UndeclaredColumn where there is none."""
    if name not in COLUMNS:
        raise UndeclaredColumn(
            f"the material column {name!r:.60} is not declared here; expected one of "
            f"{', '.join(COLUMNS)}. Declare it as it was where it was made "
            "(docs/how-to/material_column.md)."
        )
    return COLUMNS[name]


def default_rows(count: int) -> NDArray[np.float32]:
    """Return `count` material rows [count, width] with every declared column at its default."""
    row = np.concatenate([np.full(each.width, each.default) for each in COLUMNS.values()])
    return np.tile(row.astype(np.float32), (count, 1))


def columns_in_use(materials: NDArray[np.float32], but: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of the columns that are not at their default in some row, without `but`."""
    return tuple(
        column.name
        for column, part in laid_out()
        if column.name not in but and (materials[:, part] != np.float32(column.default)).any()
    )


def stored_columns(materials: NDArray[np.float32]) -> tuple[str, ...]:
    """Return the columns that a file of these rows holds: the published ones, and others in use."""
    return (*PUBLISHED_COLUMNS, *columns_in_use(materials, PUBLISHED_COLUMNS))


def column_places() -> dict[str, slice]:
    """Return where the numbers of each declared column stand in the material rows of a scene."""
    return {column.name: part for column, part in laid_out()}


def chosen_columns(materials: NDArray[np.float32], names: Sequence[str]) -> NDArray[np.float32]:
    """Return rows [M, width of `names`] with these columns of rows that have all, in this order."""
    places = column_places()
    return np.concatenate([materials[:, places[name]] for name in names], axis=1)


def stored_names(names: Sequence[str]) -> str | None:
    """Return what a file says of its columns: JSON of names and widths; None of the published."""
    if tuple(names) == PUBLISHED_COLUMNS:
        return None
    return json.dumps([[name, declared_column(name).width] for name in names])


def completed_rows(stored: NDArray[np.float32], stated: str | None) -> NDArray[np.float32]:
    """Return rows with all declared columns of those that a file holds; others get defaults.

    Args:
        stored: [M, width] as the file has them.
        stated: what it says of its columns (`stored_names`).

    Raises:
        TrilightError: a column is not declared here, or has another width; or `stated` is not of
            this form or does not fit the array.
    """
    names = PUBLISHED_COLUMNS if stated is None else _names_of(stated)
    width = material_width(names)
    if stored.ndim != 2 or stored.shape[1] != width:
        raise TrilightError(
            f"scene: materials has shape {stored.shape}; expected (None, {width}) with None for "
            f"any length, since its columns are {', '.join(names)}."
        )
    if names == tuple(COLUMNS):
        return stored
    rows = default_rows(len(stored))
    places = column_places()
    for column, part in laid_out(names):
        rows[:, places[column.name]] = stored[:, part]
    return rows


def _names_of(stated: str) -> tuple[str, ...]:
    pairs = read_json(stated, tuple[tuple[str, int], ...], "scene: its material columns")
    for name, width in pairs:
        if (declared_width := declared_column(name).width) != width:
            _wrong(
                name, f"a width of {width} in the file", f"{declared_width}, as it is declared here"
            )
    names = tuple(name for name, _ in pairs)
    if len(set(names)) != len(names):
        raise TrilightError(f"scene: its material columns are {stated:.80}; expected each once.")
    return names


def _wrong(name: str, got: str, expected: str) -> None:
    raise TrilightError(f"material column {name!r:.60} has {got}; expected {expected}.")


_PLACES = column_places()

DIFFUSE, SPECULAR, EMISSION = (_PLACES[name] for name in ("diffuse", "specular", "emission"))
"""Places of the published columns in a material row, for code that means exactly them."""
ROUGHNESS = _PLACES["roughness"].start
REFLECTING = slice(0, EMISSION.start)
"""Albedos and roughness: what stands before the emission."""


def distinct_rows(rows: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where each distinct row first stands, in that order, and which one each row is.

    Rows [N, K] are compared by their bytes.
    """
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.shape[1] * 4))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    return np.sort(first), rank[inverse]
