"""What a compiler would make of kernels that it may merge: an estimate, on the safe side.

Kernels that are limited by memory become one where they belong to one visit of one compiled part,
one way, are loops over equally many elements (or half as many, the halves that rotations turn), one
reads what the other reads or writes, and no kernel has to run between them. What only they read is
never written. Two casts of one tensor become one. These are the rules of torch's inductor, which
does more: it also computes again what is cheaper computed than kept, and here all is kept.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from infra.bench.roofline.trace import Access, Kernel, Part, Traced

_MERGED = ("cast", "pointwise")


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
        self._groups: list[_Group] = []
        self._writer: dict[int, _Group] = {}
        self._readers: dict[int, list[_Group]] = {}
        self._same: dict[int, int] = {}
        self._casts: dict[object, int] = {}

    def add(self, index: int, kernel: Kernel) -> None:
        """Take the next kernel: into a group that is there, or one of its own."""
        kernel = self._renamed(kernel)
        may = kernel.kind in _MERGED and kernel.launches == 1 and self._is_compiled(kernel.part)
        if may and self._is_known_cast(kernel):
            return
        asked = {self._writer[a.storage] for a in kernel.reads if a.storage in self._writer}
        group = self._found(kernel, asked) if may else None
        if group is None:
            group = _Group()
            self._groups.append(group)
        group.members.append((index, kernel))
        group.asks |= asked - {group}
        for access in kernel.reads:
            self._readers.setdefault(access.storage, []).append(group)
        for access in kernel.writes:
            self._writer[access.storage] = group

    def _renamed(self, kernel: Kernel) -> Kernel:
        if not any(access.storage in self._same for access in kernel.reads):
            return kernel
        values = {**vars(kernel), "reads": tuple(self._original(a) for a in kernel.reads)}
        return Kernel(**values)

    def _original(self, access: Access) -> Access:
        storage = self._same.get(access.storage, access.storage)
        return Access(storage=storage, size=access.size, layout=access.layout)

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

    def _found(self, kernel: Kernel, asked: set[_Group]) -> _Group | None:
        """Return the latest group that the kernel may belong to."""
        beside = {g for a in kernel.reads for g in self._readers.get(a.storage, [])[-8:]}
        for group in sorted(asked | beside, key=lambda each: -each.last):
            if self._alike(kernel, group) and not _needs(asked - {group}, group):
                return group
        return None

    def _alike(self, kernel: Kernel, group: _Group) -> bool:
        other = group.members[0][1]
        if other.kind not in _MERGED or other.launches != 1:
            return False
        if (other.part, other.is_backward) != (kernel.part, kernel.is_backward):
            return False
        most = max(each.elements for _, each in group.members)
        return kernel.elements in (most, 2 * most) or 2 * kernel.elements == most

    def merged(self) -> Traced:
        """Return the kernels that are left, and the memory that they need."""
        kept, inner = [], set[int]()
        readers = {storage: set(groups) for storage, groups in self._readers.items()}
        at: dict[int, int] = {}
        for group in sorted(self._groups, key=lambda each: each.last):
            own = {a.storage for _, kernel in group.members for a in kernel.writes}
            gone = {
                storage
                for storage in own
                if len(group.members) > 1
                and readers.get(storage, set()) <= {group}
                and storage in self._traced.died
                and self._traced.born[storage][0] >= group.first
            }
            inner |= gone
            for index, _ in group.members:
                at[index] = len(kept)
            kept.append(_one(group, gone, self._traced))
        inner |= self._same.keys()
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


def _one(group: _Group, gone: set[int], traced: Traced) -> Kernel:
    """Return a group as one kernel, which reads and writes what others see."""
    kernels = [kernel for _, kernel in group.members]
    if len(kernels) == 1:
        return kernels[0]
    made = {a.storage for kernel in kernels for a in kernel.writes}
    before = {storage for storage in made if traced.born[storage][0] < group.first}
    own = made - before
    reads = {a: None for kernel in kernels for a in kernel.reads if a.storage not in own}
    writes = {a: None for kernel in kernels for a in kernel.writes if a.storage not in gone}
    only_casts = all(kernel.kind == "cast" for kernel in kernels)
    return Kernel(
        name="+".join(dict.fromkeys(kernel.name.removeprefix("aten::") for kernel in kernels)),
        kind="cast" if only_casts else "pointwise",
        launches=1,
        reads=_once(reads, traced),
        writes=_once(writes, traced),
        flops=0,
        product_type="",
        elements=max(kernel.elements for kernel in kernels),
        part=kernels[0].part,
        is_backward=kernels[0].is_backward,
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
    return Traced(kernels=kept, born=born, died=died, waits=traced.waits)
