"""Laws of the estimate of a compiler, on kernels made by hand."""

from typing import Any

from infra.bench.roofline.fusion import fused
from infra.bench.roofline.prediction import peak_bytes
from infra.bench.roofline.trace import Access, Kernel, Traced

SIZE, ELEMENTS = 512, 128
PART = ("layer", 1)


def _traced(*rows: tuple[str, str, tuple[int, ...], int], lives: tuple[int, ...] = ()) -> Traced:
    """Return kernels (name, kind, storages read, storage written); `lives` are not given back."""
    kernels: list[Kernel] = []
    traced = Traced(kernels=kernels)
    for index, (name, kind, reads, write) in enumerate(rows):
        for storage in reads:
            traced.born.setdefault(storage, (0, SIZE))
        traced.born.setdefault(write, (index, SIZE))
        values: dict[str, Any] = {
            "name": f"aten::{name}", "kind": kind, "launches": 1,
            "reads": tuple(_access(storage) for storage in reads), "writes": (_access(write),),
            "flops": int(kind == "product"), "product_type": "", "elements": ELEMENTS,
            "part": PART, "is_backward": False,
        }  # fmt: skip
        kernels.append(Kernel(**values))
    made = {row[3] for row in rows}
    traced.died = {storage: len(rows) for storage in made - set(lives)}
    return traced


def _access(storage: int) -> Access:
    return Access(storage=storage, size=SIZE, layout=("float32", (ELEMENTS,)))


def _names(traced: Traced) -> list[str]:
    return [kernel.name.removeprefix("aten::") for kernel in traced.kernels]


def test_a_chain_is_one_kernel_that_writes_its_end_alone() -> None:
    chain = _traced(
        ("mul", "pointwise", (0, 1), 2), ("add", "pointwise", (2, 0), 3), lives=(3,)
    )  # fmt: skip
    (one,) = fused(chain, lambda _: True).kernels
    assert one.name == "mul+add" and one.num_bytes == 3 * SIZE
    assert {access.storage for access in one.writes} == {3}
    assert peak_bytes(fused(chain, lambda _: True)) == peak_bytes(chain) - SIZE


def test_what_is_not_compiled_stays() -> None:
    chain = _traced(("mul", "pointwise", (0,), 1), ("add", "pointwise", (1,), 2))
    assert _names(fused(chain, lambda _: False)) == ["mul", "add"]


def test_a_product_between_two_keeps_them_apart() -> None:
    rows = (
        ("mul", "pointwise", (0,), 1),
        ("mm", "product", (1, 5), 2),
        ("add", "pointwise", (2, 1), 3),
    )
    found = fused(_traced(*rows), lambda _: True)
    assert _names(found) == ["mul", "mm", "add"]
    assert found.kernels[0].writes, "what others read is written"


def test_a_product_beside_does_not() -> None:
    rows = (
        ("mul", "pointwise", (0,), 1),
        ("mm", "product", (0, 5), 2),
        ("add", "pointwise", (2, 1), 3),
    )
    found = fused(_traced(*rows), lambda _: True)
    assert sorted(_names(found)) == ["mm", "mul+add"]


def test_two_casts_of_one_tensor_are_one() -> None:
    rows = (
        ("_to_copy", "cast", (0,), 1),
        ("mm", "product", (1, 5), 2),
        ("_to_copy", "cast", (0,), 3),
        ("mm", "product", (3, 6), 4),
    )
    found = fused(_traced(*rows), lambda _: True)
    assert _names(found) == ["_to_copy", "mm", "mm"]
    assert {access.storage for access in found.kernels[2].reads} == {1, 6}


def test_another_number_of_elements_is_another_loop() -> None:
    traced = _traced(("mul", "pointwise", (0,), 1), ("add", "pointwise", (1,), 2))
    second = traced.kernels[1]
    traced.kernels[1] = Kernel(**{**vars(second), "elements": 3 * ELEMENTS})
    assert _names(fused(traced, lambda _: True)) == ["mul", "add"]
    traced.kernels[1] = Kernel(**{**vars(second), "part": ("layer", 2)})
    assert _names(fused(traced, lambda _: True)) == ["mul", "add"], "nor is another layer"
