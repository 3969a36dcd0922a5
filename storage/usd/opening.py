"""Opening a USD file of a stranger: what may be read, and how large it may become.

A USD file can name other files, the network, itself, and multiply prims by reference without end.
So every layer that composition would open is opened here first, by the path that USD's own resolver
gives, and is refused outside of the folder. Then the prims that composition would make are
counted over the graph of references, which is cheap since each prim is counted once; a circle is
found by the same walk. The bytes are still parsed by native code: whoever opens files of strangers
does so in a child process with limits (pipeline.isolation).
"""

import re
import zipfile
from pathlib import Path
from typing import Any

from storage.errors import TrilightError
from storage.usd.diagnostics import said

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MAX_FILE_BYTES = 1 << 30
"""Of one file; a million triangles take about 70 MB."""
MAX_LAYERS = 1000
MAX_PRIMS = 500_000
"""That composition may make; instances of one prototype count once."""
MAX_DEPTH = 150
"""Of prims within prims, counted through references."""
MAX_MEMBERS = 10_000
"""Of a usdz archive."""

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]*:")


class OpenedUsd:
    """A root layer, and the only way to the files that it names."""

    def __init__(self, path: Path, folder: Path | None = None) -> None:
        """Open the root layer alone.

        Args:
            path: the file.
            folder: files below it may be read; the folder of `path` by default.

        Raises:
            TrilightError: not a readable USD file, or larger than it may be.
        """
        self.path = path.resolve()
        self.folder = (folder or self.path.parent).resolve()
        self.lost: list[str] = []
        self._layers: dict[str, Any] = {}
        self.root = self._open(str(self.path))

    def inside(self, layer: Any, asset_path: str) -> str | None:
        """Return where USD finds a file that a layer names, or None where there is none.

        Raises:
            TrilightError: it is on the network, or outside of the folder.
        """
        from pxr import Ar, Sdf

        plain, _ = Sdf.Layer.SplitIdentifier(asset_path)
        if _SCHEME.match(plain):
            raise TrilightError(
                f"{self.path.name}: names {plain!r:.100}; expected files below its own folder: "
                "nothing is fetched."
            )
        identifier = Sdf.ComputeAssetPathRelativeToLayer(layer, plain)
        found = str(Ar.GetResolver().Resolve(identifier))
        outer = found.partition("[")[0] if found else identifier.partition("[")[0]
        target = Path(outer).resolve()
        if not target.is_relative_to(self.folder) or ".." in Path(plain.partition("[")[2]).parts:
            raise TrilightError(
                f"{self.path.name}: names {plain!r:.100}, which is outside of its folder; copy it "
                "there."
            )
        return found or None

    def compose(self) -> Any:
        """Return the composed stage, after a walk over everything that it will be made of.

        Raises:
            TrilightError: a file outside, the network, a circle, or too much of something.
        """
        from pxr import Usd

        counted = _Walk(self).size(self.root, self._default_path(self.root, "/"), 0)
        if counted > MAX_PRIMS:
            raise TrilightError(
                f"{self.path.name}: would make {counted} prims; expected at most {MAX_PRIMS}."
            )
        stage = Usd.Stage.Open(self.root, Usd.Stage.LoadAll)
        for error in stage.GetCompositionErrors():
            text = " ".join(str(error).replace(f"{self.folder}/", "").split())
            if "Could not open asset" in text:
                continue  # the walk has noted it
            if "cycle" in text.lower():
                raise TrilightError(
                    f"{self.path.name}: refers to itself in a circle ({text:.160})."
                )
            self.lost.append(f"composition: {text:.160}")
        return stage

    def _default_path(self, layer: Any, path: Any) -> Any:
        from pxr import Sdf

        return Sdf.Path(str(path)) if path else Sdf.Path(f"/{layer.defaultPrim}")

    def layer(self, anchor: Any, asset_path: str) -> Any:
        """Return the layer that another one names, or None where it is missing (it is noted)."""
        found = self.inside(anchor, asset_path)
        suffix = Path(asset_path.partition("[")[2].rstrip("]") or asset_path).suffix.lower()
        if found is None or suffix not in SUFFIXES:
            why = "is missing" if found is None else "is no USD file"
            self._note(f"file {asset_path!r:.100} {why}")
            return None
        return self._open(found)

    def _note(self, text: str) -> None:
        if text not in self.lost:
            self.lost.append(text)

    def _open(self, resolved: str) -> Any:
        from pxr import Sdf, Tf

        if resolved in self._layers:
            return self._layers[resolved]
        if len(self._layers) >= MAX_LAYERS:
            raise TrilightError(f"{self.path.name}: names more than {MAX_LAYERS} layers.")
        outer = Path(resolved.partition("[")[0])
        _check_file(outer)
        try:
            layer = Sdf.Layer.FindOrOpen(resolved)
        except Tf.ErrorException as error:
            why = said(error, outer)
            raise TrilightError(f"{outer.name}: not readable as USD ({why}).") from error
        if layer is None:
            raise TrilightError(f"{outer.name}: not readable as USD.")
        self._layers[resolved] = layer
        return layer


class _Walk:
    """Counts the prims below a path, through sublayers, references, payloads and variants."""

    def __init__(self, opened: OpenedUsd) -> None:
        self._opened = opened
        self._sizes: dict[tuple[str, str], int] = {}
        self._open: set[tuple[str, str]] = set()
        self._stacks: dict[str, list[Any]] = {}

    def size(self, layer: Any, path: Any, depth: int) -> int:
        """Return how many prims composition makes of one; never fewer than it does."""
        key = (layer.identifier, str(path))
        name = self._opened.path.name
        if key in self._sizes:
            return self._sizes[key]
        if key in self._open:
            raise TrilightError(
                f"{name}: {path} refers to itself in a circle; remove one reference."
            )
        if depth > MAX_DEPTH:
            raise TrilightError(f"{name}: {path} is nested more than {MAX_DEPTH} deep.")
        self._open.add(key)
        specs = [each.GetPrimAtPath(path) for each in self._stack(layer)]
        total = 1
        for spec in filter(None, specs):
            total += self._of_spec(layer, spec, depth + 1)
        self._open.discard(key)
        self._sizes[key] = min(total, 1 << 60)
        return self._sizes[key]

    def _of_spec(self, layer: Any, spec: Any, depth: int) -> int:
        if any(key.startswith("clip") for key in spec.ListInfoKeys()):
            raise TrilightError(
                f"{self._opened.path.name}: {spec.path} uses value clips, which are not read; bake "
                "them."
            )
        targets = list(self._targets(spec))
        total = sum(self.size(layer, child.path, depth) for child in spec.nameChildren)
        below = sum(self.size(target or layer, path, depth) for target, path in targets)
        total += 0 if spec.HasInfo("instanceable") and spec.instanceable else below
        for variants in spec.variantSets.values():
            for variant in variants.variants.values():
                total += self._of_spec(layer, variant.primSpec, depth)
        return total

    def _targets(self, spec: Any) -> list[tuple[Any, Any]]:
        """Return (layer or None for the same, path) of every arc of a prim."""
        found: list[tuple[Any, Any]] = []
        for arcs in (spec.referenceList, spec.payloadList):
            for arc in arcs.GetAddedOrExplicitItems():
                target = None
                if arc.assetPath:
                    target = self._opened.layer(spec.layer, arc.assetPath)
                    if target is None:
                        continue
                path = arc.primPath
                if not path:
                    default = (target or spec.layer).defaultPrim
                    if not default:
                        continue
                    path = default if default.startswith("/") else f"/{default}"
                found.append((target, path))
        for paths in (spec.inheritPathList, spec.specializesList):
            found += [(None, path) for path in paths.GetAddedOrExplicitItems()]
        return found

    def _stack(self, layer: Any) -> list[Any]:
        """Return a layer with its sublayers, in any order."""
        if layer.identifier not in self._stacks:
            stack: list[Any] = []
            self._sublayers(layer, stack, [])
            self._stacks[layer.identifier] = stack
        return self._stacks[layer.identifier]

    def _sublayers(self, layer: Any, stack: list[Any], above: list[str]) -> None:
        name = self._opened.path.name
        if layer.identifier in above:
            raise TrilightError(f"{name}: its layers name one another in a circle.")
        if len(above) > MAX_DEPTH or len(stack) > MAX_LAYERS:
            raise TrilightError(f"{name}: has too many layers within layers.")
        stack.append(layer)
        for asset_path in layer.subLayerPaths:
            below = self._opened.layer(layer, asset_path)
            if below is not None:
                self._sublayers(below, stack, [*above, layer.identifier])


def _check_file(path: Path) -> None:
    """Refuse what is too large; and an archive that is compressed, or names what is not in it."""
    try:
        size = path.stat().st_size
        if not path.is_file() or not 0 < size <= MAX_FILE_BYTES:
            raise TrilightError(
                f"{path.name}: {size} bytes; expected a file of 1 to {MAX_FILE_BYTES}."
            )
        if path.suffix.lower() == ".usdz":
            _check_package(path, size)
    except OSError as error:
        raise TrilightError(f"{path.name}: cannot be read ({error.strerror}).") from error


def _check_package(path: Path, size: int) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        raise TrilightError(f"{path.name}: not a readable usdz archive ({error}).") from error
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
