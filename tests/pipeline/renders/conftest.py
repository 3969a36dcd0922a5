"""Mitsuba is activated once for all render tests, as a render child does it."""

from collections.abc import Iterator

import pytest

from pipeline.renders.mitsuba_variant import Variant, activate, choose_variant
from pipeline.renders.renderer import set_threads


@pytest.fixture(scope="session", autouse=True)
def variant() -> Variant:
    """What this machine renders with."""
    chosen = choose_variant()
    activate(chosen)
    set_threads(2)
    return chosen


@pytest.fixture
def llvm(variant: Variant) -> None:
    """Skips where no LLVM library works."""
    if variant.name != "llvm_ad_rgb":
        pytest.skip(variant.note)


@pytest.fixture
def unrecorded(llvm: None) -> Iterator[None]:
    """Every pass is traced: for tests that put another kernel in."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        yield
