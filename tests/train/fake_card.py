"""A graphics card that is not there: the project's own code runs on it, and nothing is computed.

Inside `fake_card()` tensors have shapes, types and a device, and no numbers (torch's
FakeTensorMode). Mixing devices, forgetting to move a module, or asking the card for something whose
size only the numbers tell fails as on a card, within seconds for any size of network. Speed and
numbers are not its business.

Nothing of the project is replaced. Of its libraries this is, and why:
    guard and hooks of CUDA    a torch without CUDA has none, and its backward pass asks for them;
                               they have to be there first, hence `card_process`
    torch.cuda's answers       there is a card, it knows bfloat16, and has so much memory
    reading numbers            there are none: `.item()` is one, `.numpy()` and files are zeros, and
                               files stay empty where they would be large
    Module.to                  it would have old and new weights swap places, and fake ones cannot;
                               here the new ones take the place of the old
"""

import os
import shutil
import subprocess
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import safetensors.numpy
import safetensors.torch
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from model.attention import cut_windows

CARD = torch.device("cuda", 0)
GUARD = Path(__file__).with_name("guard.cpp")
MEMORY_BYTES = 80 << 30
FILE_BYTES = 64 << 20
"""Files whose tensors have more are written without them."""


class _Mode(FakeTensorMode):
    avoid_device_init = True
    """torch.tensor(..., device="cuda") makes no real tensor on the way."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "_Mode":
        """Stay one, where a network is copied: a tensor holds its mode, and would copy it too."""
        return self

    def dispatch(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Answer with one, or yes, whoever reads a single number."""
        if func is torch.ops.aten._local_scalar_dense.default:
            return {torch.bool: True, torch.int64: 1}.get(args[0].dtype, 1.0)
        if func._overloadpacket is torch.ops.aten._fused_sgd_:
            return None  # torch says of all other fused updates that they change no shape
        result: Any = super().dispatch(func, types, args, kwargs or {})
        if func is torch.ops.aten.lift_fresh.default:
            result.constant = None  # of torch.tensor: nobody is to compute with it in earnest
        return result


@contextmanager
def fake_card() -> Iterator[None]:
    """Have a card for as long as it lasts; every tensor that torch makes meanwhile is fake."""
    cut_windows.cache_clear()
    with ExitStack() as stack:
        for owner, name, answer in _answers():
            stack.enter_context(mock.patch.object(owner, name, answer, create=True))
        stack.enter_context(_Mode(allow_non_fake_inputs=True))
        stack.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", "Accessing the data pointer of FakeTensor")
        try:
            yield
        except Exception as error:  # torch's own cannot always travel between processes
            raise AssertionError(f"{type(error).__name__}: {error}") from error
    cut_windows.cache_clear()


def _answers() -> list[tuple[Any, str, Any]]:
    """Return what is asked of whom, and what to do in its place."""
    return [
        (torch.cuda, "is_available", lambda: True),
        (torch.cuda, "device_count", lambda: 1),
        (torch.cuda, "set_device", lambda _: None),
        (torch.cuda, "is_bf16_supported", lambda *_: True),
        (torch.cuda, "mem_get_info", lambda _: (MEMORY_BYTES, MEMORY_BYTES)),
        (torch.cuda.amp.common, "amp_definitely_not_available", lambda: False),
        (FakeTensor, "numpy", _zeros),
        (FakeTensor, "data_ptr", lambda _: 0),
        (safetensors.torch, "serialize", _file_of_zeros),
        (nn.Module, "_apply", _applied),
    ]


def _applied(module: nn.Module, change: Callable[[Tensor], Tensor]) -> nn.Module:
    for child in module.children():
        child._apply(change)
    for name, weight in module._parameters.items():
        if weight is not None:
            changed = change(weight.detach())
            module._parameters[name] = nn.Parameter(changed, requires_grad=weight.requires_grad)
    for name, buffer in module._buffers.items():
        module._buffers[name] = None if buffer is None else change(buffer)
    return module


def _zeros(tensor: FakeTensor) -> NDArray:
    if tensor.device.type != "cpu":
        raise TypeError(f"can't convert {tensor.device} device type tensor to numpy")
    return np.zeros(tuple(tensor.shape), str(tensor.dtype).removeprefix("torch."))


def _file_of_zeros(tensors: Mapping[str, Any], metadata: dict[str, str]) -> bytes:
    zeros = {name: np.zeros(spec.shape, np.float32) for name, spec in tensors.items()}
    if sum(array.nbytes for array in zeros.values()) > FILE_BYTES:
        zeros = {}
    data: bytes = safetensors.numpy.save(zeros, metadata)
    return data


@contextmanager
def card_process(folder: Path) -> Iterator[ProcessPoolExecutor]:
    """Yield a process with what torch lacks (guard.cpp); what it is sent may use `fake_card`.

    The test is skipped where torch lacks it and there is no C++ compiler that works, or torch has
    it and no driver. `folder` is for the compiled library, which only this process loads.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        with mock.patch.dict(os.environ, _preloaded(folder)):
            process.submit(os.getpid).result()  # it starts with the first call
        yield process


def _preloaded(folder: Path) -> dict[str, str]:
    if torch.version.cuda is not None:
        if not torch.cuda.is_available():  # its own guard and hooks ask the driver
            pytest.skip(f"torch {torch.__version__} is built for CUDA, and there is no driver")
        return {}
    others = os.environ.get("LD_PRELOAD", "").split()
    return {"LD_PRELOAD": " ".join([str(_compiled(folder)), *others])}


def _compiled(folder: Path) -> Path:
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler: set CXX or install g++")
    torch_folder, library = Path(torch.__file__).parent, folder / "fake_card.so"
    places = [f"-I{torch_folder / 'include'}", f"-L{torch_folder / 'lib'}"]
    found = f"-Wl,-rpath,{torch_folder / 'lib'}"
    command = [compiler, "-std=c++20", "-shared", "-fPIC", *places, found, str(GUARD)]
    ran = subprocess.run(
        [*command, "-lc10", "-ltorch_cpu", "-o", str(library)],
        capture_output=True,
        text=True,
        check=False,
    )
    if ran.returncode:
        pytest.skip(f"{compiler} cannot compile {GUARD.name}: {ran.stderr.strip()[-400:]}")
    return library
