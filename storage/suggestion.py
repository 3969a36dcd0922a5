"""What to say of a name that nobody knows: the names that are known, the closest one first."""

from collections.abc import Iterable
from difflib import get_close_matches


def expected_one_of(name: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name, with what was probably meant.

    Such as `did you mean smoke? Expected one of smoke, pretrain-256`, without a full stop.
    """
    names = list(known)
    listed = f"xpected one of {', '.join(names)}"
    close = get_close_matches(name, names, n=1)
    return f"did you mean {close[0]}? E{listed}" if close else f"e{listed}"
