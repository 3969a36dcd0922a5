"""Decimation by meshoptimizer: its two simplifiers never crashed, hung or left the box in tests.

Their vertices are a subset of the source's, which costs about twice the error of edge collapse with
free placement, at a twentieth of its time.

Both are WebAssembly of their author's npm packages: that needs no compiler, and cannot harm the
process. 0.22 gives the triangles of the native library of that version, bit by bit. The sloppy
simplifier is exported since 0.25.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import wasmtime

from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected

_ANY_ERROR = 1e9
"""Error bound of the library, set out of reach: the budget and the quality checks decide."""

_NO_LOCKS = _NO_OPTIONS = _NO_ERROR = 0


def simplify(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    """Return the mesh with at most `budget` faces where its topology allows that many collapses."""
    return _Library("0.22.0").run(
        "meshopt_simplify", mesh, (3 * budget, _ANY_ERROR, _NO_OPTIONS, _NO_ERROR)
    )


def simplify_sloppily(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    """Return the mesh with at most `budget` faces whatever its topology.

    Vertices that share a cell of a grid become one (Rossignac and Borrel 1993).
    """
    return _Library("0.25.0").run(
        "meshopt_simplifySloppy", mesh, (_NO_LOCKS, 3 * budget, _ANY_ERROR, _NO_ERROR)
    )


@functools.cache
class _Library:
    """Instance of a version of the library, with memory of its own."""

    def __init__(self, version: str) -> None:
        path = Path(__file__).with_name(f"meshoptimizer-{version}.wasm")
        config = wasmtime.Config()
        config.memory_reservation = 0  # else 4 GiB of address space, which a child may not have
        config.memory_reservation_for_growth = 16 << 20
        config.memory_guard_size = 0
        self._store = wasmtime.Store(wasmtime.Engine(config))
        module = wasmtime.Module.from_file(self._store.engine, str(path))
        self._exports: Any = wasmtime.Instance(self._store, module, []).exports(self._store)
        self._call("__wasm_call_ctors")

    def run(self, function: str, mesh: TriangleMesh, options: tuple[float, ...]) -> TriangleMesh:
        """Return a mesh simplified on float32, which holds the grid of clean positions exactly."""
        corners = np.ascontiguousarray(mesh.faces, np.uint32)
        positions = np.ascontiguousarray(mesh.positions, np.float32)
        end = self._call("sbrk", 0)
        try:
            simplified = self._store_bytes(bytes(corners.nbytes))
            source = (self._store_bytes(corners.tobytes()), corners.size)
            vertices = (self._store_bytes(positions.tobytes()), *positions.shape[:1], 12)
            count = self._call(function, simplified, *source, *vertices, *options)
            memory = self._exports["memory"]
            data = memory.read(self._store, simplified, simplified + 4 * count)
        except (wasmtime.WasmtimeError, wasmtime.Trap) as error:
            raise Rejected("decimation_failed", "meshoptimizer stopped at this mesh") from error
        finally:
            self._call("sbrk", end - self._call("sbrk", 0))
        faces = np.frombuffer(data, np.uint32).reshape(-1, 3).astype(np.int64)
        return TriangleMesh(positions=mesh.positions, faces=faces)

    def _store_bytes(self, data: bytes) -> int:
        """Copy bytes into the memory of the instance, and return their address there."""
        address = self._call("sbrk", -(-len(data) // 16) * 16)
        if address == -1:
            raise Rejected("decimation_failed", "meshoptimizer: the mesh has over 4 GiB")
        self._exports["memory"].write(self._store, data, address)
        return address

    def _call(self, function: str, *arguments: float) -> int:
        return self._exports[function](self._store, *arguments)
