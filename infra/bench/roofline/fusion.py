"""What a compiler would make of kernels that it may merge: an estimate, not a compiler's output.

Kernels that are limited by memory become one where they belong to one visit of one compiled part,
one way, one reads what the other reads or writes, their loops fit, and no other kernel has to run
between them. What only they read is never written. Two casts of one tensor become one, and a SiLU
is computed again on the way back, not kept. These are rules of torch's inductor; it knows more of
both kinds, and fewer where a loop would grow too large.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from infra.bench.roofline.trace import Access, Kernel, Part, Traced

_MERGED = ("cast", "pointwise")
_ALONE = ("aten::index_select", "aten::index_put_", "aten::embedding")
"""Kernels that read or write where other numbers say; counted alone, to be on the safe side."""

BROADCAST = 64
"""A loop of so many times fewer elements is computed again within the larger one."""


@dataclass(eq=False)
class _Group:
    members: list[tuple[int, Kernel]] = field(default_factory=list)
    asks: set["_Group"] = field(default_factory=set)

    @property
    def first(self) -> int:
        return self.members[0][0]

    @property
    def last(self) -> int:
        return self.members[-1][0]

    @property
    def elements(self) -> int:
        return max(kernel.elements for _, kernel in self.members)


def fused(traced: Traced, is_compiled: Callable[[Part], bool]) -> Traced:
    """Return the step as it would be with the parts compiled for which `is_compiled` is true."""
    merger = _Merger(traced, is_compiled)
    for index, kernel in enumerate(traced.kernels):
        merger.add(index, kernel)
    return merger.merged()


class _Merger:
    def __init__(self, traced: Traced, is_compiled: Callable[[Part], bool]) -> None:
        self._traced = traced
        self._is_compiled = is_compiled
        self._groups: dict[_Group, None] = {}
        self._writer: dict[int, _Group] = {}
        self._readers: dict[int, list[_Group]] = {}
        self._same: dict[int, int] = {}
        self._casts: dict[object, int] = {}
        self._again: dict[int, Access] = {}

    def add(self, index: int, kernel: Kernel) -> None:
        """Take the next kernel: into a group that is there, or one of its own."""
        kernel = replace(kernel, reads=tuple(self._read(kernel, a) for a in kernel.reads))
        may = self._may(kernel)
        if may and self._is_known_cast(kernel):
            return
        if may and kernel.name == "aten::silu":
            self._again[kernel.writes[0].storage] = kernel.reads[0]
        asked = {self._writer[a.storage] for a in kernel.reads if a.storage in self._writer}
        group = self._joined(kernel, asked) if may else None
        if group is None:
            group = _Group()
            self._groups[group] = None
        group.members.append((index, kernel))
        group.asks |= asked - {group}
        group.asks.discard(group)
        for access in kernel.reads:
            self._readers.setdefault(access.storage, []).append(group)
        for access in kernel.writes:
            self._writer[access.storage] = group

    def _may(self, kernel: Kernel) -> bool:
        mergeable = kernel.kind in _MERGED and kernel.name not in _ALONE
        return mergeable and kernel.launches == 1 and self._is_compiled(kernel.part)

    def _read(self, kernel: Kernel, access: Access) -> Access:
        """Return what is read in truth: the first of equal casts, the input of a SiLU."""
        if kernel.is_backward and access.storage in self._again:
            access = self._again[access.storage]
        return replace(access, storage=self._same.get(access.storage, access.storage))

    def _is_known_cast(self, kernel: Kernel) -> bool:
        if kernel.kind != "cast":
            return False
        (write,) = kernel.writes
        key = (kernel.part, kernel.is_backward, kernel.reads, write.layout)
        if key not in self._casts:
            self._casts[key] = write.storage
            return False
        self._same[write.storage] = self._casts[key]
        return True

    def _joined(self, kernel: Kernel, asked: set[_Group]) -> _Group | None:
        """Return the group that the kernel belongs to, made one of all that it may join."""
        beside = {g for a in kernel.reads for g in self._readers.get(a.storage, [])[-8:]}
        found: _Group | None = None
        for group in sorted(asked | beside, key=lambda each: -each.last):
            if group not in self._groups or not self._fits(kernel, group):
                continue
            if _needs(asked - {group} - ({found} if found else set()), group):
                continue
            if found is None:
                found = group
            elif group in asked and not _between(found, group):
                self._merge(found, group)
        return found

    def _fits(self, kernel: Kernel, group: _Group) -> bool:
        other = group.members[0][1]
        if not self._may(other) or (other.part, other.is_backward) != (
            kernel.part,
            kernel.is_backward,
        ):
            return False
        most, own = group.elements, kernel.elements
        if own in (most, 2 * most) or 2 * own == most:  # rotations turn halves
            return True
        made = {a.storage for _, each in group.members for a in each.writes}
        if own < most:  # what follows a reduction
            return sum(a.size for a in kernel.reads if a.storage not in made) <= sum(
                a.size for a in kernel.writes
            ) and any(a.storage in made for a in kernel.reads)
        return kernel.name == "aten::cat" or most * BROADCAST <= own

    def _merge(self, into: _Group, group: _Group) -> None:
        into.members = sorted([*into.members, *group.members], key=lambda member: member[0])
        into.asks = (into.asks | group.asks) - {into, group}
        del self._groups[group]
        for other in self._groups:
            if group in other.asks:
                other.asks = (other.asks - {group}) | ({into} - {other})
        for storage, writer in self._writer.items():
            if writer is group:
                self._writer[storage] = into
        for readers in self._readers.values():
            readers[:] = [into if reader is group else reader for reader in readers]

    def merged(self) -> Traced:
        """Return the kernels that are left, and the memory that they need."""
        kept: list[Kernel] = []
        inner, at = set(self._same), dict[int, int]()
        readers = {storage: set(groups) for storage, groups in self._readers.items()}
        for group in sorted(self._groups, key=lambda each: each.last):
            gone = {
                access.storage
                for _, kernel in group.members
                for access in kernel.writes
                if len(group.members) > 1
                and readers.get(access.storage, set()) <= {group}
                and access.storage in self._traced.died
                and self._traced.born[access.storage][0] >= group.first
            }
            inner |= gone
            at |= {index: len(kept) for index, _ in group.members}
            kept.append(_one(group, gone, self._traced))
        return _with_memory(self._traced, kept, at, inner, self._same)


def _needs(groups: Iterable[_Group], target: _Group) -> bool:
    """Return whether one of the groups has to run after the target."""
    waiting, seen = list(groups), set[int]()
    while waiting:
        group = waiting.pop()
        if id(group) in seen or group.last < target.first:
            continue
        seen.add(id(group))
        if group is target:
            return True
        waiting.extend(group.asks)
    return False


def _between(one: _Group, other: _Group) -> bool:
    """Return whether a third group has to run after one of the two and before the other."""
    return _needs(one.asks - {other}, other) or _needs(other.asks - {one}, one)


def _one(group: _Group, gone: set[int], traced: Traced) -> Kernel:
    """Return a group as one kernel, which reads and writes what others see."""
    kernels = [kernel for _, kernel in group.members]
    if len(kernels) == 1:
        return kernels[0]
    made = {a.storage for kernel in kernels for a in kernel.writes}
    own = made - {storage for storage in made if traced.born[storage][0] < group.first}
    reads = {a: None for kernel in kernels for a in kernel.reads if a.storage not in own}
    writes = {a: None for kernel in kernels for a in kernel.writes if a.storage not in gone}
    only_casts = all(kernel.kind == "cast" for kernel in kernels)
    return replace(
        kernels[-1],
        name="+".join(dict.fromkeys(kernel.name.removeprefix("aten::") for kernel in kernels)),
        kind="cast" if only_casts else "pointwise",
        reads=_once(reads, traced),
        writes=_once(writes, traced),
        elements=group.elements,
    )


def _once(accesses: Iterable[Access], traced: Traced) -> tuple[Access, ...]:
    """Return one access for each storage, of no more bytes than it has."""
    sizes: dict[int, int] = {}
    for access in accesses:
        most = traced.born[access.storage][1]
        sizes[access.storage] = min(sizes.get(access.storage, 0) + access.size, most)
    return tuple(Access(storage=key, size=size, layout=()) for key, size in sizes.items())


def _with_memory(
    traced: Traced, kept: list[Kernel], at: dict[int, int], inner: set[int], same: dict[int, int]
) -> Traced:
    """Return the kernels with the lives of what is still kept, counted in these kernels."""
    places, place = [], 0
    for index in range(len(traced.kernels) + 1):
        place = max(place, at.get(index, place))
        places.append(place)
    died = {s: places[index] for s, index in traced.died.items() if s not in inner}
    for copy, original in same.items():
        if original in died:
            last = traced.died.get(copy)
            died[original] = len(kept) if last is None else max(died[original], places[last])
    born = {s: (places[i], size) for s, (i, size) in traced.born.items() if s not in inner}
    return replace(traced, kernels=kept, born=born, died=died)
