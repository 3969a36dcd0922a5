"""Open Image Denoise as we call it."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders import denoiser, variant_probe
from pipeline.renders.denoiser import (
    denoise,
    load_oidn,
    set_denoiser_device,
    set_denoiser_threads,
)
from pipeline.renders.tracer import Features
from tests.conftest import ROOT


def _noisy_step() -> tuple[NDArray[np.float32], NDArray[np.float32], Features]:
    rng = np.random.default_rng(0)
    clean = np.zeros((48, 48, 3), np.float32)
    clean[8:, :24], clean[8:, 24:] = 0.2, 3.0
    noisy = (clean * rng.gamma(4.0, 0.25, clean.shape)).astype(np.float32)
    normal = np.where(clean > 0, np.array([0, 0, 1], np.float32), np.float32(0))
    albedo = np.clip(clean, 0, 1).astype(np.float32)
    return clean, noisy, Features(albedo=albedo, normal=normal)


def test_noise_goes_and_edges_stay() -> None:
    clean, noisy, features = _noisy_step()
    for quality in ("high", "fast"):
        picture = denoise(noisy, features, quality)
        assert np.abs(picture - clean).mean() < 0.25 * np.abs(noisy - clean).mean()


def test_the_background_is_exactly_black() -> None:
    _, noisy, features = _noisy_step()
    np.testing.assert_array_equal(denoise(noisy, features, "high")[:8], 0)


def test_light_without_auxiliary_pictures_is_kept() -> None:
    """A pixel is background only if neither features nor samples saw anything there."""
    _, noisy, _ = _noisy_step()
    nothing = Features(albedo=np.zeros_like(noisy), normal=np.zeros_like(noisy))
    assert (denoise(noisy, nothing, "high")[8:] > 0).all()


def test_threads_change_no_bit() -> None:
    _, noisy, features = _noisy_step()
    pictures = []
    for threads in (1, 2):
        set_denoiser_threads(threads)
        pictures.append(denoise(noisy, features, "high"))
    np.testing.assert_array_equal(pictures[0], pictures[1])


def test_the_denoiser_brings_no_torch() -> None:
    code = (
        "import sys; from pipeline.renders.denoiser import load_oidn; load_oidn(); "
        "print('torch' in sys.modules)"
    )
    child = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert child.stdout.strip() == "False"


def test_a_picture_without_light_stays_black() -> None:
    """The filter alone would paint what it sees of the albedo."""
    _, noisy, features = _noisy_step()
    for quality in ("high", "fast"):
        np.testing.assert_array_equal(denoise(np.zeros_like(noisy), features, quality), 0)


class _Card:
    """Open Image Denoise on a machine with a card, which the processor stands for."""

    def __init__(self, supported: bool, error: str | None = None, brightens: float = 1.0) -> None:
        self._oidn = load_oidn()
        self.opened = list[int]()
        card = self

        class Device(self._oidn.Device):  # type: ignore[name-defined]
            def __init__(self, kind: int) -> None:
                card.opened.append(kind)
                self.is_card = kind == card._oidn.OIDN_DEVICE_TYPE_CUDA
                super().__init__(card._oidn.OIDN_DEVICE_TYPE_CPU)

            def set_int(self, name: str, value: int) -> None:
                assert not self.is_card, f"a card has no {name}"
                super().set_int(name, value)

            def set_bool(self, name: str, value: bool) -> None:
                assert not self.is_card, f"a card has no {name}"
                super().set_bool(name, value)

            def get_error(self) -> str | None:
                return error if self.is_card and error else super().get_error()

            @staticmethod
            def is_cuda_available(device_id: int = 0) -> bool:
                return supported

        class Filter(self._oidn.Filter):  # type: ignore[name-defined]
            def set_image(self, name: str, data: object, *rest: object, **named: object) -> None:
                assert isinstance(data, card._oidn.Buffer), "a card does not see numpy's memory"
                super().set_image(name, data, *rest, **named)

        class Buffer(self._oidn.Buffer):  # type: ignore[name-defined]
            def read(self, offset: int, size: int, picture: NDArray[np.float32]) -> None:
                super().read(offset, size, picture)
                # One half alone: the mean brightness of a picture is that of its samples anyway.
                picture[: len(picture) // 2] *= brightens if self._device.is_card else 1

        self.Device, self.Filter, self.Buffer = Device, Filter, Buffer

    def __getattr__(self, name: str) -> object:
        return getattr(self._oidn, name)


@pytest.fixture
def put_in(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[_Card], None]]:
    """Put a card in; afterwards it is out, and no filter of it is left."""

    def put(card: _Card) -> None:
        monkeypatch.setattr(denoiser, "load_oidn", lambda: card)
        denoiser._filter.cache_clear()

    yield put
    set_denoiser_device("CPU")
    denoiser._filter.cache_clear()


def test_the_card_is_used_where_it_is_chosen(put_in: Callable[[_Card], None]) -> None:
    _, noisy, features = _noisy_step()
    on_processor = denoise(noisy, features, "high")
    card = _Card(supported=True)
    put_in(card)
    set_denoiser_device("CUDA")
    np.testing.assert_array_equal(denoise(noisy, features, "high"), on_processor)
    assert card.opened == [load_oidn().OIDN_DEVICE_TYPE_CUDA]


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    ("card", "said"),
    [
        ({"supported": True}, ""),
        ({"supported": False}, "Open Image Denoise does not support the graphics card"),
        ({"supported": True, "error": "no memory"}, "Open Image Denoise: no memory (on CUDA)"),
        ({"supported": True, "brightens": 1.1}, "Open Image Denoise gives another picture"),
        ({"supported": True, "brightens": np.nan}, "Open Image Denoise gives another picture"),
    ],
)
def test_a_card_that_cannot_denoise_is_not_used(
    card: dict[str, Any], said: str, put_in: Callable[[_Card], None]
) -> None:
    put_in(_Card(**card))
    problem = variant_probe.denoiser_problem()
    assert problem.startswith(said) and bool(problem) == bool(said)
