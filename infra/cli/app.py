"""The command `trilight`: what it does with a mistake, and with Ctrl-C."""

import logging
import os
import resource
import shlex
import signal
import sys
from types import FrameType

from cyclopts import CycloptsError

from infra.cli.commands import app, complaint
from infra.cli.extending import extended
from infra.cli.leaving import InertFormatter, leave, open_missing_streams
from storage.errors import EnvironmentFailure, TrilightError
from storage.extensions import mistake_in_extension

_ENOUGH_BYTES = 2 << 30
_ROOM = [bytearray(16 << 20)]  # given back where memory lacks, so that it can be said


def main() -> None:
    """Run the command line; a mistake of the user is one line on stderr and exit status 1."""
    # torch's threads would wait for each other in busy loops, which beside other work made training
    # twelve times slower; read when torch is imported, and a setting of the user's own wins
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it tells of caches
    os.environ["MPLBACKEND"] = "agg"  # a notebook's, or one that is not there, ends the import
    if not os.environ.get("COLUMNS", "80").strip("0"):  # rich prints nothing in no columns
        del os.environ["COLUMNS"]
    signal.signal(signal.SIGINT, _interrupted)
    open_missing_streams()
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(InertFormatter())
    try:
        _require_usable_names()
        if "TRILIGHT_CONFINE" in os.environ:  # at once, though no file may have to be read
            from pipeline.isolation.confinement import wanted_confinement

            wanted_confinement()
        app(extended(sys.argv[1:]))
        sys.stdout.flush()
    except CycloptsError as mistake:
        leave(f"trilight: {complaint(mistake)}", 2)
    except TrilightError as mistake:
        leave(f"trilight: {mistake}{_describe_limit()}", mistake.exit_status)
    except Exception as error:
        _ROOM.clear()
        its_author = mistake_in_extension(error)
        if its_author is not None:
            leave(f"trilight: {its_author}", 1)
        if isinstance(error, OSError):
            _blame_output(error)
        _leave_without_memory(error)
        raise


def _leave_without_memory(error: Exception) -> None:
    """End with a sentence where memory lacks: every library fails in its own way then."""
    if isinstance(error, MemoryError) or _describe_limit():
        said = f"too little memory ({type(error).__name__}); what was finished is safe."
        leave(f"trilight: {said}{_describe_limit()}", EnvironmentFailure.exit_status)


def _describe_limit() -> str:
    """Return a sentence about a limit of memory that few commands get along with, or ""."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= _ENOUGH_BYTES:
        return ""
    return (
        f" A process of this shell may take {limit >> 20} MiB of memory; expected "
        f"{_ENOUGH_BYTES >> 20} or more, since less may be the reason: raise `ulimit -v`."
    )


def _blame_output(error: OSError) -> None:
    """Leave where nothing can be printed any more."""
    try:
        os.write(sys.stdout.fileno(), b"\n")
    except OSError:
        said = f"what is printed cannot be written ({error.strerror}); choose another place"
        leave(f"trilight: {said}. What was finished is safe.", 1)


def _require_usable_names() -> None:
    """Refuse a working folder that is gone, and names that no file format can hold."""
    try:
        names = [os.getcwd(), *sys.argv[1:]]
    except OSError as error:
        raise TrilightError(
            f"the working folder cannot be used ({error.strerror}); expected one that exists. "
            "Change to another folder, and run the command again."
        ) from error
    for name in names:
        if not name.isascii() and name != name.encode(errors="replace").decode():
            raise TrilightError(
                f"the name {name!a} is no text in {sys.getfilesystemencoding()}; expected "
                "names in UTF-8. Rename it, or set LC_ALL=C.UTF-8."
            )


def _interrupted(signal_number: int, frame: FrameType | None) -> None:
    again = shlex.join(["trilight", *sys.argv[1:]])
    leave(f"trilight: interrupted. What was finished is safe; to go on, run: {again}", 130)


if __name__ == "__main__":
    main()
