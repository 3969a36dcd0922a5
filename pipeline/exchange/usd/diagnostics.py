"""What USD says of a broken file, as one line that names the file and nothing of this machine."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from storage.errors import TrilightError

Read = TypeVar("Read")

_MAX_LETTERS = 300


def quietly(path: Path, read: Callable[[], Read]) -> Read:
    """Return what `read` makes of a file, without USD's own warnings on standard error.

    Raises:
        TrilightError: as `read`, or it met what is broken, or of another type than USD states.
    """
    from pxr import Tf, UsdUtils

    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        return read()
    except TrilightError:
        raise
    except Tf.ErrorException as error:
        raise TrilightError(f"{path.name}: not readable as USD ({said(error, path)}).") from error
    except (TypeError, ValueError, AttributeError, LookupError, OverflowError) as error:
        raise TrilightError(
            f"{path.name}: holds a value of another kind than USD states ({said(error, path)})."
        ) from error
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


def said(error: Exception, path: Path) -> str:
    """Return what an error says, without USD's own source files and the folder of `path`."""
    try:
        text = " ".join(str(error).split())
    except UnicodeDecodeError:  # it cites the file
        return "bytes that are no text"
    found = re.findall(r"\.(?:cpp|h|yy) : '(.*?)'?(?= Error in |$)", text)
    text = (found[-1] if found else text).replace(f"{path.resolve().parent}/", "")
    return "".join(letter if letter.isprintable() else "?" for letter in text)[:_MAX_LETTERS]
