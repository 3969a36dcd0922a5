"""The part of a page that a program writes, between two marks that a person has set.

<!-- NAME:begin -->  ...everything between is written...
<!-- NAME:end -->
"""

from pathlib import Path

from storage.atomic import write_atomically
from storage.errors import TrilightError


def read_block(page: Path, name: str) -> str:
    """Return what stands between the marks of a page.

    Raises:
        TrilightError: a mark is missing, or they are there twice.
    """
    return _parts(page, name)[1]


def write_block(page: Path, name: str, text: str) -> None:
    """Write the block anew; all else of the page stays. Raises TrilightError as `read_block`."""
    before, _, after = _parts(page, name)
    write_atomically(page, f"{before}{text}{after}".encode())


def _parts(page: Path, name: str) -> tuple[str, str, str]:
    text = page.read_text()
    begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->\n"
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise TrilightError(
            f"{page.name}: expected one line {begin.strip()} and, after it, one {end.strip()}."
        )
    before, rest = text.split(begin)
    inside, after = rest.split(end)
    return before + begin, inside, end + after
