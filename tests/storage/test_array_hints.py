"""Both ways in which numpy spells NDArray[X] say X."""

from typing import Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

from storage import array_hints
from storage.array_hints import array_scalar
from tests.for_each import for_each

_Kept = TypeVar("_Kept", bound=np.generic)
AliasOfLater = TypeAliasType(  # what numpy 2.5 has in the place of NDArray
    "AliasOfLater", np.ndarray[Any, np.dtype[_Kept]], type_params=(_Kept,)
)


@for_each("scalar", [np.float32, np.int64, np.floating[Any]])
def test_the_scalar_is_read_of_either(scalar: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert array_scalar(NDArray[scalar]) == scalar
    monkeypatch.setattr(array_hints, "NDArray", AliasOfLater)
    assert array_scalar(AliasOfLater[scalar]) == scalar


def test_what_is_no_array_has_none() -> None:
    assert array_scalar(tuple[int, int]) is None
    assert array_scalar(int) is None
