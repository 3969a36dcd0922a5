"""Sandbox of children that read untrusted files: their inputs, libraries, and nothing else.

Limits of memory and time stop accidents. Confinement stops a file that takes over its parser: it
reaches no other file, no network, no program, no other process. Each restriction applies if the
kernel supports it. None of them changes how a file is read, or any byte of the output.
"""

import functools
import logging
import mimetypes
import os
import site
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, cast, get_args

from pipeline.isolation.system_calls import (
    give_up_privileges,
    landlock_version,
    refuse_calls,
    restrict_files,
    seccomp_works,
)
from storage.errors import EnvironmentFailure, TrilightError, expected_one_of
from storage.installation import FILES_ROOT, IMPORT_ROOT

log = logging.getLogger("trilight.children")

VARIABLE = "TRILIGHT_CONFINE"
"""Environment variable: `auto`, `off`, or `required`, which fails if a feature is missing."""
Mode = Literal["auto", "off", "required"]

MOST_FOLDERS = 256
"""Most input folders of one child; if there are more, their parent folders replace them."""

_OWN_PACKAGES = ("storage", "scene_templates", "pipeline", "trilight")
_SYSTEM = (
    "/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache", "/etc/localtime", "/etc/fonts",
    "/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/sys/vm",
    "/sys/devices/system", "/sys/kernel/mm", "/sys/fs/cgroup", "/dev/urandom", "/dev/random",
    "/nix/store", "/gnu/store",
)  # fmt: skip
_SINKS = ("/dev/null", "/dev/zero")


Reach = frozenset[Path]
"""User files and folders that a confined child may read; absolute paths without links."""
NO_FILES: Reach = frozenset()


def reach(files: Iterable[Path]) -> Reach:
    """Return the reach of a child that reads some files or folders.

    A file's folder is included: meshes and scenes refer to their textures, and never to files above
    or beside their folder. Very many folders are merged to their parent folders.
    """
    folders: set[Path] = set()
    for path in files:
        absolute = Path(os.path.abspath(path))
        if absolute.is_dir():
            folders.add(absolute.resolve())
        else:  # also a link's target: USD resolves paths from its folder
            folders |= {absolute.parent.resolve(), absolute.resolve().parent}
    return merge_folders(folders)


def covers(allowed: Reach, more: Reach) -> bool:
    """Return True if a reach includes all files of another one."""
    return all(path in allowed or not allowed.isdisjoint(path.parents) for path in more)


def confinement_mode() -> Mode:
    """Return the value of TRILIGHT_CONFINE, by default `auto`; raises TrilightError for others."""
    text = os.environ.get(VARIABLE, "auto")
    if text in get_args(Mode):
        return cast(Mode, text)
    raise TrilightError(f"{VARIABLE} is {text!r}; {expected_one_of(text, get_args(Mode))}.")


def missing_features() -> list[str]:
    """Return the names of features that this machine lacks to confine children."""
    missing = [] if landlock_version() else ["Landlock (Linux 5.13 or later, switched on)"]
    return missing if seccomp_works() else [*missing, "seccomp (Linux on x86_64 or aarch64)"]


def should_confine() -> bool:
    """Return True if TRILIGHT_CONFINE demands that children that read files are confined.

    A missing feature is logged as a warning, once.

    Raises:
        EnvironmentFailure: the value is `required`, and this machine lacks a feature.
        TrilightError: the value is unknown.
    """
    mode = confinement_mode()
    missing = missing_features()
    if missing and mode == "required":
        raise EnvironmentFailure(
            f"{VARIABLE} is required, but this machine lacks {' and '.join(missing)}; expected "
            f"both. Run elsewhere, or set {VARIABLE}=auto."
        )
    if missing and mode == "auto":
        _warn(" and ".join(missing))
    return mode != "off"


@functools.cache
def _warn(missing: str) -> None:
    log.warning(
        "children that read untrusted files are not fully confined: this machine lacks %s. Run "
        "`trilight doctor`, or set %s=off to accept that.", missing, VARIABLE,
    )  # fmt: skip


def confine(reads: Reach, writes: Reach) -> None:
    """Confine this process by all features that the kernel supports; it must have one thread.

    Args:
        reads: user files and extensions that stay accessible.
        writes: folders in which files may be written.

    Raises:
        EnvironmentFailure: the kernel refuses a feature that it reports.
    """
    try:
        os.setsid()
        if sys.platform == "linux":
            give_up_privileges()
        if landlock_version():
            packages = [FILES_ROOT / name for name in _OWN_PACKAGES]
            restrict_files(
                reads=[*_libraries(), *packages, *reads],
                writes=[*(Path(sink) for sink in _SINKS), *writes],
                lists=[FILES_ROOT, IMPORT_ROOT],
            )
        if seccomp_works():
            refuse_calls()
    except OSError as error:
        raise EnvironmentFailure(
            f"a child that reads files cannot be confined ({error.strerror}); expected what "
            f"`trilight doctor` says is there. Set {VARIABLE}=off to continue without."
        ) from error


def _libraries() -> list[Path]:
    """Return the folders of Python and its packages, and the system files that they read."""
    python = {sys.prefix, sys.base_prefix, sys.exec_prefix, *site.getsitepackages()}
    if site.ENABLE_USER_SITE and site.USER_SITE:
        python.add(site.USER_SITE)
    # from PYTHONPATH, as modules of clusters set it, only package folders: others may hold anything
    python |= {name for name in sys.path if Path(name).name in ("site-packages", "dist-packages")}
    more = [name for name in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if name]
    return [Path(name) for name in (*python, *_SYSTEM, *more, *mimetypes.knownfiles)]


def merge_folders(paths: Iterable[Path]) -> Reach:
    """Return at most MOST_FOLDERS folders that contain all paths, never the file system's root."""
    folders = frozenset(paths)
    while len(folders) > MOST_FOLDERS:
        above = frozenset(
            path if path.parent == path.parent.parent else path.parent for path in folders
        )
        if above == folders:
            break
        folders = above
    return frozenset(path for path in folders if folders.isdisjoint(path.parents))
