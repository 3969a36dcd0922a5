"""A writer of glTF in its dialects, by the format's text alone, with what a reader must find."""

import base64
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

_CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


@dataclass
class GltfWriter:
    """A tree that grows, and its buffer."""

    tree: dict[str, Any] = field(default_factory=lambda: {"asset": {"version": "2.0"}})
    data: bytearray = field(default_factory=bytearray)

    def add(self, kind: str, row: dict[str, Any]) -> int:
        """Add an entry to a list of the tree; return its number."""
        self.tree.setdefault(kind, []).append(row)
        return len(self.tree[kind]) - 1

    def use(self, name: str) -> None:
        """State an extension as used."""
        if name not in self.tree.setdefault("extensionsUsed", []):
            self.tree["extensionsUsed"].append(name)

    def view(self, data: bytes, **more: Any) -> int:
        self.data += bytes(-len(self.data) % 4)
        start = len(self.data)
        self.data += data
        row = {"buffer": 0, "byteOffset": start, "byteLength": len(data), **more}
        return self.add("bufferViews", row)

    def accessor(
        self, values: NDArray, code: str, *, layout: str = "plain", normalized: bool = False
    ) -> int:
        """Store values [N, K], plain, strided, sparse, or sparse over zeros."""
        stored = np.asarray(values, f"<{code}").reshape(len(values), -1)
        row: dict[str, Any] = {
            "componentType": _CODES[code], "count": len(stored), "type": _KINDS[stored.shape[1]]
        }  # fmt: skip
        if normalized:
            row["normalized"] = True
        if layout == "strided":
            step = stored[:1].nbytes + 4 + -stored[:1].nbytes % 4
            rows = np.full((len(stored), step), 0xAB, np.uint8)
            rows[:, : stored[:1].nbytes] = stored.view(np.uint8).reshape(len(stored), -1)
            row |= {"bufferView": self.view(b"\1\2\3\4" + rows.tobytes(), byteStride=step)}
            row["byteOffset"] = 4
        elif layout == "plain":
            row["bufferView"] = self.view(stored.tobytes())
        else:
            replaced = np.flatnonzero((stored != 0).any(axis=1)) if layout == "zeros" else [0]
            if layout == "sparse":
                other = stored.copy()
                other[0] += 1
                row["bufferView"] = self.view(other.tobytes())
            if len(replaced):
                where = self.view(np.asarray(replaced, "<u2").tobytes())
                what = self.view(stored[replaced].tobytes())
                row["sparse"] = {
                    "count": len(replaced),
                    "indices": {"bufferView": where, "componentType": 5123},
                    "values": {"bufferView": what},
                }
        return self.add("accessors", row)

    def save(self, folder: Path, form: str) -> Path:
        """Write the file as `glb`, `glb with chunks`, `data` or `bin`; return its path."""
        buffer: dict[str, Any] = {"byteLength": len(self.data)}
        self.tree["buffers"] = [buffer]
        if form == "data":
            packed = base64.b64encode(self.data).decode()
            buffer["uri"] = f"data:application/vnd.odd+x;charset=x;base64,{packed}"
        elif form == "bin":
            (folder / "some name.bin").write_bytes(bytes(self.data) + b"beyond")
            buffer["uri"] = "some%20name.bin"
        text = json.dumps(self.tree).encode()
        if not form.startswith("glb"):
            path = folder / "a.gltf"
            path.write_bytes(b"\xef\xbb\xbf" + text + b"\n")
            return path
        chunks = [(b"JSON", text + b" " * (-len(text) % 4))]
        chunks.append((b"BIN\0", bytes(self.data) + bytes(-len(self.data) % 4)))
        if form == "glb with chunks":
            chunks.append((b"ODD!", b"12345678"))
        body = b"".join(struct.pack("<I4s", len(part), kind) + part for kind, part in chunks)
        path = folder / "a.glb"
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
        return path


def matrix_of(translation: Any, rotation: Any, scale: Any) -> NDArray[np.float64]:
    """Return [4, 4] of a translation, a unit quaternion (x, y, z, w) and a scale."""
    found = np.eye(4)
    found[:3, :3] = Rotation.from_quat(rotation).as_matrix() * scale
    found[:3, 3] = translation
    return found
