"""What a child that reads strangers' files may reach: its inputs, libraries, and nothing else.

Limits of memory and time end what goes wrong by accident. A file that is made to take over its
parser is held by these: no other file, no network, no program, no other process. Each holds where
the kernel has it. How a file is read changes by none of them, thus no byte that is made of it.
"""

import functools
import logging
import mimetypes
import os
import site
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

from pipeline.isolation.landlock import give_up_privileges, landlock_version, restrict_files
from pipeline.isolation.seccomp import refuse_calls, seccomp_works
from storage.errors import EnvironmentFailure, TrilightError, expected_one_of
from storage.installation import FILES_ROOT, IMPORT_ROOT

log = logging.getLogger("trilight.children")

VARIABLE = "TRILIGHT_CONFINE"
"""Environment variable: `auto`, `off`, or `required`, which stops where a part is missing."""
Wanted = Literal["auto", "off", "required"]

MOST_FOLDERS = 256
"""Of inputs that one child knows; more of them are replaced by the folders that hold them."""

_OWN_PACKAGES = ("storage", "scene_templates", "pipeline", "trilight")
_SYSTEM = (
    "/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache", "/etc/localtime", "/etc/fonts",
    "/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/sys/vm",
    "/sys/devices/system", "/sys/kernel/mm", "/sys/fs/cgroup", "/dev/urandom", "/dev/random",
    "/nix/store", "/gnu/store",
)  # fmt: skip
_SINKS = ("/dev/null", "/dev/zero")


@dataclass(frozen=True, kw_only=True)
class Reach:
    """Files of a user's that a confined child may use; all paths absolute, without links."""

    reads: frozenset[Path] = frozenset()
    """Files and folders that it may read."""
    writes: frozenset[Path] = frozenset()
    """Folders that it may read and write."""

    def covers(self, other: "Reach") -> bool:
        """Return whether all that another one may is in this one too."""
        return _covered(other.writes, self.writes) and _covered(
            other.reads, self.reads | self.writes
        )

    def with_all_of(self, other: "Reach") -> "Reach":
        """Return what both may, with the folders above where there are very many."""
        writes = self.writes | other.writes
        return Reach(reads=_few(self.reads | other.reads), writes=writes)


NO_FILES = Reach()


def reach(*, files: Iterable[Path] = (), writes: Iterable[Path] = ()) -> Reach:
    """Return what a child needs to read files, with what lies beside them, and to write.

    Args:
        files: files or folders to read. A file's folder counts too: meshes and scenes name their
            textures, and nothing above or beside their folder is theirs.
        writes: folders to write, which exist.
    """
    found: set[Path] = set()
    for path in files:
        absolute = Path(os.path.abspath(path))
        if absolute.is_dir():
            found.add(absolute.resolve())
        else:  # a link's target too, whose folder counts for USD
            found |= {absolute.parent.resolve(), absolute.resolve().parent}
    return Reach(reads=_few(found), writes=frozenset(Path(path).resolve() for path in writes))


def wanted_confinement() -> Wanted:
    """Return what TRILIGHT_CONFINE says, `auto` by default; TrilightError where it is no such."""
    text = os.environ.get(VARIABLE, "auto")
    if text in get_args(Wanted):
        return cast(Wanted, text)
    raise TrilightError(f"{VARIABLE} is {text!r}; {expected_one_of(text, get_args(Wanted))}.")


def missing_parts() -> list[str]:
    """Return what this machine lacks to confine children, in words."""
    missing = [] if landlock_version() else ["Landlock (Linux 5.13 or later, switched on)"]
    return missing if seccomp_works() else [*missing, "seccomp (Linux on x86_64 or aarch64)"]


def confinement_wanted() -> bool:
    """Return whether children that read files are to be confined, as TRILIGHT_CONFINE says.

    A part that this machine lacks is a warning, once.

    Raises:
        EnvironmentFailure: it is `required`, and this machine lacks something.
        TrilightError: it is no word that is known.
    """
    wanted, missing = wanted_confinement(), missing_parts()
    if missing and wanted == "required":
        raise EnvironmentFailure(
            f"{VARIABLE} is required, but this machine lacks {' and '.join(missing)}; expected "
            f"both. Run elsewhere, or set {VARIABLE}=auto."
        )
    if missing and wanted == "auto":
        _warn(" and ".join(missing))
    return wanted != "off"


@functools.cache
def _warn(missing: str) -> None:
    log.warning(
        "what reads strangers' files is not wholly confined: this machine lacks %s. Run "
        "`trilight doctor`, or set %s=off to accept that.", missing, VARIABLE,
    )  # fmt: skip


def code_of(*functions: Callable[..., object]) -> frozenset[Path]:
    """Return the top packages, or files, that a child imports to call these functions."""
    tops = (sys.modules.get(function.__module__.partition(".")[0]) for function in functions)
    files = (getattr(top, "__file__", None) for top in tops)
    paths = (Path(file).resolve() for file in files if file is not None)
    return frozenset(path.parent if path.name == "__init__.py" else path for path in paths)


def confine(allowed: Reach, code: frozenset[Path]) -> None:
    """Confine this process, which has one thread, by all that the kernel has.

    Args:
        allowed: the files of a user's.
        code: Python files and packages that it has to load.

    Raises:
        EnvironmentFailure: the kernel refuses what it says it has.
    """
    try:
        os.setsid()
        if sys.platform == "linux":
            give_up_privileges()
        if landlock_version():
            own = [FILES_ROOT / name for name in _OWN_PACKAGES]
            restrict_files(
                reads=[*_libraries(), *own, *code, *allowed.reads],
                writes=[*(Path(sink) for sink in _SINKS), *allowed.writes],
                lists=[FILES_ROOT, IMPORT_ROOT, *(path.parent for path in code)],
            )
        if seccomp_works():
            refuse_calls()
    except OSError as error:
        raise EnvironmentFailure(
            f"a child that reads files cannot be confined ({error.strerror}); expected what "
            f"`trilight doctor` says is there. Set {VARIABLE}=off to go on without."
        ) from error


def _libraries() -> list[Path]:
    """Return where Python and its packages lie, and what they look at of the system."""
    python = {sys.prefix, sys.base_prefix, sys.exec_prefix, *site.getsitepackages()}
    if site.ENABLE_USER_SITE and site.USER_SITE:
        python.add(site.USER_SITE)
    # of PYTHONPATH, as clusters' modules set it: but not all of it, which may hold anything
    python |= {name for name in sys.path if Path(name).name in ("site-packages", "dist-packages")}
    more = [name for name in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if name]
    return [Path(name) for name in (*python, *_SYSTEM, *more, *mimetypes.knownfiles)]


def _covered(paths: frozenset[Path], by: frozenset[Path]) -> bool:
    return all(path in by or not by.isdisjoint(path.parents) for path in paths)


def _few(paths: Iterable[Path]) -> frozenset[Path]:
    """Return at most MOST_FOLDERS paths that hold all of these, never the root of the system."""
    found = frozenset(paths)
    while len(found) > MOST_FOLDERS:
        above = frozenset(
            path if path.parent == path.parent.parent else path.parent for path in found
        )
        if above == found:
            break
        found = above
    return frozenset(path for path in found if found.isdisjoint(path.parents))
