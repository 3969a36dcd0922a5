"""Entry point of the command line `trilight`: handles mistakes, missing memory and Ctrl-C."""

import logging
import os
import resource
import shlex
import signal
import sys
from types import FrameType

from cyclopts import CycloptsError

from infra.cli.commands import app, complaint
from infra.cli.extend_option import load_extensions
from infra.cli.process_exit import InertFormatter, leave, open_missing_streams
from storage.errors import EnvironmentFailure, TrilightError
from storage.extensions import mistake_in_extension

_ENOUGH_BYTES = 2 << 30
_ROOM = [bytearray(16 << 20)]  # freed where memory lacks, so that a message can be printed


def main() -> None:
    """Run the command line; a mistake of the user is one line on stderr and exit status 1."""
    _correct_environment()
    signal.signal(signal.SIGINT, _on_interrupt)
    open_missing_streams()
    if logging.lastResort is not None:
        logging.lastResort.setFormatter(InertFormatter())
    try:
        _require_usable_names()
        if "TRILIGHT_CONFINE" in os.environ:  # at once, though no file may have to be read
            from pipeline.isolation.confinement import confinement_mode

            confinement_mode()
        app(load_extensions(sys.argv[1:]))
        sys.stdout.flush()
        if "RANK" in os.environ:  # under torchrun: threads of torch sometimes abort a usual end
            os._exit(0)
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
            try:
                os.write(sys.stdout.fileno(), b"\n")
            except OSError:
                said = f"what is printed cannot be written ({error.strerror}); choose another place"
                leave(f"trilight: {said}. What was finished is safe.", 1)
        if isinstance(error, MemoryError) or _describe_limit():  # libraries fail in various ways
            said = f"too little memory ({type(error).__name__}); what was finished is safe."
            leave(f"trilight: {said}{_describe_limit()}", EnvironmentFailure.exit_status)
        raise


def _correct_environment() -> None:
    """Set variables by which libraries work badly, or not at all."""
    # torch's threads would spin while they wait, which made training beside other work twelve
    # times slower; torch reads the variable at its import, and a value that the user set wins
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it reports its caches
    os.environ["MPLBACKEND"] = "agg"  # a notebook's or a missing backend fails at the import
    if not os.environ.get("COLUMNS", "80").strip("0"):  # rich prints nothing in no columns
        del os.environ["COLUMNS"]
    if not os.environ.get("SOURCE_DATE_EPOCH", "0").isdecimal():  # numpy's import would fail
        del os.environ["SOURCE_DATE_EPOCH"]


def _describe_limit() -> str:
    """Return a sentence about a memory limit that is too low for most commands, or ""."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY or limit >= _ENOUGH_BYTES:
        return ""
    return (
        f" A process of this shell may take {limit >> 20} MiB of memory; expected "
        f"{_ENOUGH_BYTES >> 20} or more, since less may be the reason: raise `ulimit -v`."
    )


def _require_usable_names() -> None:
    """Refuse a missing working folder, and names that are no text."""
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


def _on_interrupt(signal_number: int, frame: FrameType | None) -> None:
    command = shlex.join(["trilight", *sys.argv[1:]])
    leave(f"trilight: interrupted. What was finished is safe; to go on, run: {command}", 130)


if __name__ == "__main__":
    main()
