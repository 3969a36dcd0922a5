"""Finds candidates for LLVM's shared library: the wheel's, then the system's, newest first.

The wheel comes first, so that the bits of pictures don't depend on the distribution's LLVM.
"""

import os
import re
import shutil
import subprocess
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib64/llvm*/lib64",
    "/usr/lib/llvm-*/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_NAME = re.compile(r"libLLVM(?:-(\d+))?(?:\.so|\.dylib)?(?:\.(\d+))?[\d.]*(?:\.so|\.dylib)?[\d.]*$")
_LDCONFIG_S = 20
_WHEEL = "karellen-llvm-core"


def llvm_libraries() -> list[Path]:
    """Return what may be LLVM: DRJIT_LIBLLVM_PATH, the wheel's, the others by falling version.

    Symbolic links are resolved, so that one library is named once.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    candidates = {path.resolve() for path in (*_known_to_loader(), *_in_usual_folders())}
    ordered = sorted(candidates, key=lambda path: (-_major_version(path), str(path)))
    first = [Path(named).resolve()] if named else []
    return [path for path in dict.fromkeys([*first, *_of_wheel(), *ordered]) if path.is_file()]


def _of_wheel() -> list[Path]:
    try:
        members = files(_WHEEL) or []
    except PackageNotFoundError:
        return []
    return [Path(str(file.locate())).resolve() for file in members if _NAME.match(file.name)]


def _major_version(path: Path) -> int:
    match = _NAME.match(path.name)
    numbers = [int(group) for group in match.groups() if group] if match else []
    return numbers[0] if numbers else 0


def _known_to_loader() -> Iterable[Path]:
    ldconfig = shutil.which("ldconfig") or shutil.which("ldconfig", path="/sbin:/usr/sbin")
    if ldconfig is None:
        return []
    listing = subprocess.run(
        [ldconfig, "-p"], capture_output=True, text=True, timeout=_LDCONFIG_S, check=False
    ).stdout
    return [Path(path) for path in re.findall(r"=> (\S*/libLLVM[-.]\S*)", listing)]


def _in_usual_folders() -> Iterable[Path]:
    for pattern in _FOLDERS:
        for folder in Path("/").glob(pattern.lstrip("/")):
            for name in ("libLLVM*.so*", "libLLVM*.dylib"):
                yield from (path for path in folder.glob(name) if _NAME.match(path.name))
