"""Extensions (plugins), files of a user: loaded once in a process, and known by their bytes.

`--extend FILE.py` and `FILE.py:FUNCTION` name such files on a command line; nothing else may.
Processes that are started from there load the same files, since the variable TRILIGHT_EXTEND names
them. A dataset or a checkpoint records what they were called and their sha256, and never causes
one to be loaded.
"""

import os
import re
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from storage.digests import sha256_hex
from storage.errors import TrilightError, expected_one_of

VARIABLE = "TRILIGHT_EXTEND"
"""Environment variable with the files for child processes: absolute paths joined by os.pathsep."""

Decided = Literal["data", "weights"]
"""What an extension may decide: the bytes of a dataset, or the weights of a network."""

_REFERENCE = re.compile(r"(?P<file>.*\.py):(?P<function>[A-Za-z_]\w*)")
_EXPECTED = "expected a Python file of your own, such as examples/template.py"


@dataclass(frozen=True, kw_only=True)
class Extension:
    """A file that was loaded."""

    path: Path
    sha256: str
    module: ModuleType
    decides: set[Decided] = field(default_factory=set)
    """Results that depend on the tables to which it added entries."""
    undo: list[Callable[[], object]] = field(default_factory=list)
    """Takes back each entry that it has registered."""

    @property
    def name(self) -> str:
        """The file's name without its folder, which may be published."""
        return self.path.name


_loaded: dict[str, Extension] = {}
_loading: list[Extension] = []


def load_extension(file: str | Path, *, sha256: str | None = None) -> Extension:
    """Load a file, once in this process, and name it to the processes that start from here.

    Args:
        file: its path.
        sha256: what its bytes must be, where another process has loaded it before.

    Raises:
        TrilightError: there is no such file, it is not Python or raises something, it registers a
            name that is taken, another one has its name, or it is not what was loaded before.
    """
    path = Path(os.path.abspath(os.path.expanduser(file)))
    known = _loaded.get(path.name)
    if known is None:
        data = _read(path, str(file))
        known = _run(path, data, sha256_hex(data))
    if known.path != path:
        raise TrilightError(
            f"extension {file}: another {path.name} is loaded already; expected extensions with "
            "names of their own. Rename one of the files."
        )
    if sha256 not in (None, known.sha256):
        raise TrilightError(
            f"extension {path.name} has changed while a run was using it; run the command again."
        )
    return known


def unload(extension: Extension) -> None:
    """Take back what an extension has registered, so that its file can be loaded again."""
    for undo in extension.undo:
        undo()
    del _loaded[extension.name], sys.modules[extension.module.__name__]
    os.environ[VARIABLE] = os.pathsep.join(
        file for file in _named_files() if file != str(extension.path)
    )


def load_named_extensions() -> None:
    """Load what TRILIGHT_EXTEND names; raises TrilightError as `load_extension`."""
    for file in _named_files():
        load_extension(file)


def _named_files() -> list[str]:
    return [file for file in os.environ.get(VARIABLE, "").split(os.pathsep) if file]


def loaded_files() -> tuple[tuple[str, str], ...]:
    """Return path and sha256 of each extension of this process, for a child to `load_same`."""
    return tuple((str(extension.path), extension.sha256) for extension in _loaded.values())


def load_same(files: Collection[tuple[str, str]]) -> None:
    """Load what another process has loaded; raises TrilightError as `load_extension`."""
    for path, sha256 in files:
        load_extension(path, sha256=sha256)


def loading() -> Extension | None:
    """Return the extension that is being loaded, if one is."""
    return _loading[-1] if _loading else None


def is_reference(name: str) -> bool:
    """Return whether a name has the form FILE.py:FUNCTION."""
    return _REFERENCE.fullmatch(name) is not None


def short_name(name: str) -> str:
    """Return a name as it may be published: of FILE.py:FUNCTION, without the folder of the file."""
    match = _REFERENCE.fullmatch(name)
    return f"{Path(match['file']).name}:{match['function']}" if match else name


def function_name(name: str) -> str:
    """Return what a folder may be called after a name: of FILE.py:FUNCTION the function."""
    match = _REFERENCE.fullmatch(name)
    return match["function"] if match else name


@contextmanager
def load_reference(reference: str) -> Iterator[Any]:
    """Provide what the function of FILE.py:FUNCTION returns, while its file may register it.

    What is no function stands for itself.

    Args:
        reference: for which `is_reference` holds; typed by the person whose computer this is.

    Raises:
        TrilightError: as `load_extension`, or the file does not define it, or it raises something.
    """
    match = _REFERENCE.fullmatch(reference)
    assert match is not None, reference
    file = match["file"]
    if file in _loaded and not Path(file).exists():  # as a record says it, without the folder
        file = str(_loaded[file].path)
    extension = load_extension(file)
    members = vars(extension.module)
    if match["function"] not in members:
        defined = [
            member
            for member, value in members.items()
            if getattr(value, "__module__", "") == extension.module.__name__
        ]
        raise TrilightError(
            f"{reference}: {extension.name} does not define {match['function']}; "
            f"{expected_one_of(match['function'], defined)}."
        )
    member = members[match["function"]]
    with _as_loading(extension), mistakes_of_entry(file=extension.name):
        yield member() if callable(member) else member


def extension_digests(part: Decided) -> dict[str, str]:
    """Return the sha256 of each extension that has part in what is made, by its name.

    One that registers nothing may do anything, and counts too. One that only adds a metric, a
    format or an executor does not: how a run is executed never changes what it means.
    """
    return {
        extension.name: extension.sha256
        for extension in _loaded.values()
        if part in extension.decides or not (extension.decides or extension.undo)
    }


def require_same_extensions(what: str, before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Refuse to go on with other extensions than something was begun with.

    Args:
        what: was begun, as messages name it.
        before, now: as `extension_digests` returns them.

    Raises:
        TrilightError: one is missing, new, or another file; the message names it.
    """
    for name in sorted({*before, *now}):
        if before.get(name) == now.get(name):
            continue
        if name not in now:
            said = f"with the extension {name}, which is not given; add --extend {name} (in other "
            said += f"processes {VARIABLE} names it)"
        elif name not in before:
            said = f"without the extension {name}; leave --extend {name} away"
        else:
            said = f"with another extension {name}: its sha256 was {before[name][:12]}, now "
            said += f"{now[name][:12]}; restore that file"
        raise TrilightError(f"{what} was begun {said}, or choose another --out.")


def _read(path: Path, display_path: str) -> bytes:
    if path.suffix != ".py" or os.pathsep in str(path):
        raise TrilightError(
            f"extension {display_path}: not the name of a Python file; {_EXPECTED}."
        )
    try:
        return path.read_bytes()
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError)
        why = f"no such file; {_EXPECTED}" if is_missing else f"cannot be read ({error.strerror})"
        raise TrilightError(f"extension {display_path}: {why}.") from error


def _run(path: Path, data: bytes, digest: str) -> Extension:
    """Run a file as a module of its own, under a name that is the same in every process."""
    module = ModuleType(f"trilight_extension_{path.stem}")
    module.__file__ = str(path)
    extension = Extension(path=path, sha256=digest, module=module)
    _loaded[path.name] = extension  # first: what it imports may load named extensions
    sys.modules[module.__name__] = module
    try:
        with _as_loading(extension), mistakes_of_entry(file=extension.name):
            exec(compile(data, str(path), "exec", dont_inherit=True), vars(module))
    except TrilightError:
        unload(extension)
        raise
    if str(path) not in _named_files():
        os.environ[VARIABLE] = os.pathsep.join([*_named_files(), str(path)])
    return extension


@contextmanager
def _as_loading(extension: Extension) -> Iterator[None]:
    _loading.append(extension)
    try:
        yield
    finally:
        _loading.pop()


@contextmanager
def mistakes_of_entry(entry: str = "", *, file: str = "") -> Iterator[None]:
    """Turn what code of an extension raises into one line with its place.

    Args:
        entry: what the code makes, such as a family.
        file: name of the extension that runs; empty where other code may raise something too.

    Raises:
        TrilightError: the code raised something; other code's errors are raised as they are.
    """
    try:
        yield
    except (Exception, SystemExit) as error:
        its_author = mistake_in_extension(error, entry)
        if its_author is None and not file:
            raise
        raise its_author or _mistake(file, None, error) from error


def mistake_in_extension(error: BaseException, entry: str = "") -> TrilightError | None:
    """Return what code of an extension raised as its author's mistake, which names file and line.

    None where no line of an extension took part. `entry` names what the code was to make.
    """
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if path.name in _loaded and _loaded[path.name].path == path:
            return _mistake(path.name, frame.lineno, error, entry)
    return None


def _mistake(name: str, line: int | None, error: BaseException, entry: str = "") -> TrilightError:
    if isinstance(error, SyntaxError):
        line = error.lineno
        said = error.msg
    else:
        said = str(error)
    kind = "" if isinstance(error, TrilightError) else f"{type(error).__name__}: "
    text = " ".join(f"{kind}{said}".split()).rstrip(".:")
    place = f"{name}{f', line {line}' if line else ''}{f', {entry}' if entry else ''}"
    return TrilightError(f"extension {place}: {text}.")
