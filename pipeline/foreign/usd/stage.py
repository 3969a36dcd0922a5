"""Opens an untrusted USD file, and decides which other files it may read.

A USD file can name other files, and the network. Which of them composition opens cannot be known
beforehand. So every file that any layer names for composition, used or not, is checked by the path
that USD's own resolver gives, is refused outside of the folder, and is opened here first: the
closure of all names holds every file that composition can ask for. The layers of the composed stage
are compared with the folder once more, before anything of it is used.
The bytes are still parsed by native code, so untrusted files are opened in a child process with
limits (pipeline.isolation).

References, payloads, inherits and variants multiply prims without end, in more ways than a walk
over the arcs of single prims sees: a reference to `</A/B>` also brings the arcs of `</A>`, and a
class is inherited again wherever its heir is referenced. So no size is predicted here. USD's own
composition engine makes the prims, in the order of the tree, and is stopped as soon as there are
too many or they take too long. A composed prim holds at most 32,767 sites, which is USD's limit.

`read_quietly` turns USD's own errors into one line that names the file, but no folder.
"""

import re
import time
import zipfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from pxr import Ar, Pcp, Sdf, Tf, Usd, UsdUtils

from pipeline.foreign.numbers import Malformed
from storage.errors import TrilightError
from storage.records.safe_read import name_unreadable

MAX_FILE_BYTES = 1 << 30
"""Maximum size of a file; a million triangles take about 70 MB."""
MAX_LAYERS = 1000
MAX_NOTES = 40
"""Maximum number of notes on one file; further notes are only counted."""
MAX_MEMBERS = 10_000
"""Maximum number of members in a usdz archive."""

MAX_PRIMS = 500_000
"""Maximum number of composed prims; instances of one prototype count once."""
MAX_DEPTH = 150
"""Maximum nesting of prims."""
MAX_COMPOSITION_S = 20.0
"""Maximum CPU seconds for all prims: 500,000 of few arcs each take 4 to 10; chains of thousands of
references, or prims of thousands of sites, take hours."""

_LOOKS = (".mtlx",)
"""Suffixes of files that hold materials only; a stage is complete in shape without them."""

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]*:")


def file_and_member(name: str) -> tuple[Path, str]:
    """Split a name of USD's resolver into its file and the member of an archive, or "".

    Brackets in folder names do not count: only those at the end of `a.usdz[b.usda]` hold a member.
    """
    outer, member = Ar.SplitPackageRelativePathOuter(name)
    return Path(outer), str(member)


class OutsideFile(TrilightError):
    """A named file that may not be read: in another folder, on the network, or no plain file."""


class OpenedStage:
    """A root layer with its notes; it resolves and opens all files that layers name."""

    def __init__(
        self, path: Path, folder: Path | None = None, *, max_file_bytes: int = MAX_FILE_BYTES
    ) -> None:
        """Open the root layer alone.

        Args:
            path: the file.
            folder: files below it may be read; the folder of `path` by default.
            max_file_bytes: maximum size of every file.

        Raises:
            TrilightError: not a readable USD file, or larger than it may be.
        """
        self.path = path.resolve()
        self.folder = (folder or self.path.parent).resolve()
        self.lost: list[str] = []
        self.unresolved: list[str] = []
        self.time = Usd.TimeCode.EarliestTime()
        """Time at which values are read: the first of an animated stage, unless it is set."""
        self._max_file_bytes = max_file_bytes
        self._layers: dict[str, Any] = {}
        self._context = Ar.GetResolver().CreateDefaultContextForAsset(str(self.path))
        self.root = self._open(str(self.path))

    @property
    def files(self) -> list[Path]:
        """Return the open files, the root first and the others sorted."""
        outer = {file_and_member(name)[0] for name in self._layers}
        return [self.path, *sorted(outer - {self.path})]

    @property
    def notes(self) -> tuple[str, ...]:
        """Return notes on unread contents, each kind once with the path of its first one."""
        kinds: dict[tuple[str, str], list[str]] = defaultdict(list)
        for note in dict.fromkeys(self.lost):
            where, _, text = note.partition(": ")
            kinds[where.partition(".")[2] if where.startswith("/") else where, text].append(note)
        notes = [
            alike[0] if len(alike) == 1 else f"{alike[0]} ({len(alike)} such)"
            for alike in kinds.values()
        ]
        more = len(notes) - MAX_NOTES
        return tuple(notes if more <= 0 else [*notes[:MAX_NOTES], f"and {more} more"])

    def resolve(self, layer: Any, asset_path: str) -> str | None:
        """Return the resolved path of a file that a layer names, or None for a missing file.

        Raises:
            OutsideFile: it is on the network, outside of the folder, no plain file, or named by a
                variable expression.
        """
        plain, arguments = Sdf.Layer.SplitIdentifier(asset_path)
        if arguments:
            self._refuse(plain, " with arguments for its file format; expected a name alone")
        if _SCHEME.match(plain):
            self._refuse(plain, "; expected files below its own folder: nothing is fetched")
        if plain.startswith("`"):
            self._refuse(plain, ", a variable expression; expected a name. Write it out")
        with Ar.ResolverContextBinder(self._context):
            identifier = Sdf.ComputeAssetPathRelativeToLayer(layer, plain)
            resolved = str(Ar.GetResolver().Resolve(identifier))
        outer = file_and_member(resolved or identifier)[0]
        if not resolved and not outer.is_absolute():
            return None  # looked for in several folders
        try:
            target = outer.resolve()
        except (OSError, RuntimeError):
            self._refuse(plain, ", which is a link without an end")
        member = file_and_member(plain)[1]
        if not target.is_relative_to(self.folder) or ".." in Path(member).parts:
            self._refuse(plain, ", which is outside of its folder; copy it there")
        if resolved and not target.is_file():  # opening a FIFO would block forever
            self._refuse(plain, ", which is no plain file")
        return resolved or None

    def compose(self) -> Any:
        """Return the composed stage; all of its files have been checked, and its prims stay valid.

        Raises:
            TrilightError: a file outside, the network, value clips, a circle, or too much of
                something.
        """
        self._open_all()
        for error in self._compose_prims():
            self._note_error(error)
        self._composed = stage = Usd.Stage.Open(self.root, self._context, Usd.Stage.LoadAll)
        for layer in stage.GetUsedLayers():
            real = file_and_member(layer.realPath)[0].resolve()
            if not layer.anonymous and not real.is_relative_to(self.folder):
                raise TrilightError(f"{self.path.name}: uses {real.name!r:.100} of another folder.")
        return stage

    def _open_all(self) -> None:
        """Open every layer that any layer names: more than composition opens, and never less."""
        waiting = [self.root]
        while waiting:
            layer = waiting.pop()
            self._refuse_clips(layer)
            for asset_path in sorted(layer.GetCompositionAssetDependencies()):
                if not asset_path:
                    continue  # within the layer itself
                known = len(self._layers)
                below = self._named_layer(layer, asset_path)
                if len(self._layers) > known:
                    waiting.append(below)

    def _refuse_clips(self, layer: Any) -> None:
        def look(path: Any) -> None:
            if path.IsPrimPath() or path.IsPrimVariantSelectionPath():
                prim = layer.GetPrimAtPath(path)  # none for a set of variants
                if prim and any(key.startswith("clip") for key in prim.ListInfoKeys()):
                    clipped.append(path)

        clipped: list[Any] = []
        layer.Traverse("/", look)
        if clipped:
            raise TrilightError(
                f"{self.path.name}: {clipped[0]} uses value clips, which are not read; bake them."
            )

    def _compose_prims(self) -> Sequence[Any]:
        """Compose all prims, payloads too, and return USD's errors; every file must be open.

        Raises:
            TrilightError: too many prims, nested too deep, or not composed in time.
        """
        cache = Pcp.Cache(Pcp.LayerStackIdentifier(self.root, None, self._context), "usd", True)
        _, errors = cache.ComputeLayerStack(cache.GetLayerStackIdentifier())
        waiting = [Sdf.Path.absoluteRootPath]
        prototypes = set()
        num_prims = 0
        start_s = time.process_time()
        while waiting:
            path = waiting.pop()
            num_prims += 1
            self._require_bounds(path, num_prims, time.process_time() - start_s)
            index, prim_errors = cache.ComputePrimIndex(path)
            if index.hasAnyPayloads:
                cache.RequestPayloads([path], [])
                index, prim_errors = cache.ComputePrimIndex(path)
            errors += prim_errors
            if index.IsInstanceable():
                prototype = Pcp.InstanceKey(index)
                if prototype in prototypes:
                    continue
                prototypes.add(prototype)
            children, _ = index.ComputePrimChildNames()
            waiting += [path.AppendChild(child) for child in children]
        return errors

    def _require_bounds(self, path: Any, num_prims: int, elapsed_s: float) -> None:
        name = self.path.name
        if num_prims > MAX_PRIMS:
            raise TrilightError(
                f"{name}: composes more than {MAX_PRIMS} prims, the most that is read."
            )
        if path.pathElementCount > MAX_DEPTH:
            raise TrilightError(
                f"{name}: prims are nested more than {MAX_DEPTH} deep ({str(path)[:60]}...)."
            )
        if elapsed_s > MAX_COMPOSITION_S:
            raise TrilightError(
                f"{name}: {num_prims} prims took {elapsed_s:.0f} processor seconds to compose and "
                f"more follow; expected all within {MAX_COMPOSITION_S:.0f}. Flatten the stage."
            )

    def _note_error(self, error: Any) -> None:
        """Note an error of composition; raises TrilightError for one that makes it unreadable."""
        if isinstance(error, Pcp.ErrorInvalidAssetPath | Pcp.ErrorInvalidSublayerPath):
            return  # noted by `_named_layer`
        site = re.search(r"<[^<>]*>$", str(error.rootSite))
        text = f"{type(error).__name__.removeprefix('Error')} {site[0] if site else ''}"
        if isinstance(error, Pcp.ErrorArcCycle | Pcp.ErrorSublayerCycle):
            raise TrilightError(f"{self.path.name}: refers to itself in a circle ({text:.160}).")
        if isinstance(error, Pcp.ErrorCapacityExceeded):
            raise TrilightError(f"{self.path.name}: too many arcs meet in one prim ({text:.160}).")
        self._miss(f"composition: {text:.160}")

    def _named_layer(self, anchor: Any, asset_path: str) -> Any:
        """Return the layer that another one names, or None with a note where it is missing."""
        resolved = self.resolve(anchor, asset_path)
        if resolved is None or Sdf.FileFormat.FindByExtension(resolved) is None:
            why = "is missing" if resolved is None else "is no USD file"
            note = f"file {asset_path!r:.100} {why}"
            if asset_path.endswith(_LOOKS):
                self.lost.append(note)
            else:
                self._miss(note)
            return None
        return self._open(resolved)

    def _miss(self, note: str) -> None:
        self.lost.append(note)
        self.unresolved.append(note)

    def _refuse(self, named: str, why: str) -> NoReturn:
        raise OutsideFile(f"{self.path.name}: names {named!r:.100}{why}.")

    def _open(self, resolved: str) -> Any:
        if resolved in self._layers:
            return self._layers[resolved]
        if len(self._layers) >= MAX_LAYERS:
            raise TrilightError(f"{self.path.name}: names more than {MAX_LAYERS} layers.")
        outer = file_and_member(resolved)[0]
        _check_file(outer, self._max_file_bytes)
        try:
            if layer := Sdf.Layer.Find(resolved):  # as an earlier call of this process read it
                layer.Reload(force=True)
            else:
                layer = Sdf.Layer.FindOrOpen(resolved)
        except Tf.ErrorException as error:
            raise TrilightError(f"{outer.name}: not readable as USD{_find_line(error)}.") from error
        if layer is None:
            raise TrilightError(f"{outer.name}: not readable as USD.")
        self._layers[resolved] = layer
        return layer


def _check_file(path: Path, max_bytes: int) -> None:
    """Refuse a file that is too large, and an archive that is compressed or inconsistent."""
    with name_unreadable(path.name):
        size = path.stat().st_size
        if not path.is_file() or not 0 < size <= max_bytes:
            raise TrilightError(f"{path.name}: {size} bytes; expected a file of 1 to {max_bytes}.")
        if path.suffix.lower() == ".usdz":
            _check_package(path, size)


def _check_package(path: Path, size: int) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        raise TrilightError(f"{path.name}: not a readable usdz archive; pack it again.") from error
    if not 1 <= len(members) <= MAX_MEMBERS:
        raise TrilightError(f"{path.name}: {len(members)} members; expected 1 to {MAX_MEMBERS}.")
    total = 0
    for member in members:
        total += member.file_size
        packed = member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1
        if packed or member.file_size != member.compress_size or total > size:
            raise TrilightError(
                f"{path.name}: member {member.filename!r:.80} is compressed or claims more bytes "
                "than the archive has; usdz stores members as they are."
            )
        if member.filename.startswith("/") or ".." in Path(member.filename).parts:
            raise TrilightError(f"{path.name}: member {member.filename!r:.80} leads outside.")


@contextmanager
def without_warnings() -> Iterator[None]:
    """Keep USD's own warnings from standard error."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()
        del delegate


@contextmanager
def read_quietly(path: Path) -> Iterator[None]:
    """Turn USD's errors on a file into ours, `without_warnings`.

    Raises:
        TrilightError: as the block, or the file is broken or has a value of a wrong type.
    """
    try:
        with without_warnings():
            yield
    except Malformed as error:
        raise Malformed(f"{path.name}: {str(error).removeprefix(f'{path.name}: ')}.") from error
    except TrilightError:
        raise
    except Tf.ErrorException as error:
        raise TrilightError(f"{path.name}: not readable as USD{_find_line(error)}.") from error
    except (TypeError, ValueError, AttributeError, LookupError, OverflowError) as error:
        raise TrilightError(
            f"{path.name}: holds a value of another kind than USD states."
        ) from error


def _find_line(error: Exception) -> str:
    """Return the line where USD's parser stopped; records hold the number, never USD's message."""
    try:
        line = re.search(r":(\d{1,9}):\d+: ", str(error))
    except UnicodeDecodeError:  # the message cites bytes of the file
        line = None
    return f" from line {line[1]} on" if line else ""
