"""A process in which torch believes that there is a card (card.fake_card), also without CUDA."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from unittest import mock

import torch

from storage.errors import TrilightError

SOURCE = Path(__file__).with_name("guard.cpp")


@contextmanager
def card_process(folder: Path) -> Iterator[ProcessPoolExecutor]:
    """Yield a process with what torch lacks (guard.cpp); what it is sent may use `fake_card`.

    Args:
        folder: for the compiled library, which only this process loads.

    Raises:
        TrilightError: torch lacks it and there is no C++ compiler, or it fails; or torch has it
            and no driver.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        with mock.patch.dict(os.environ, _preloaded(folder)):
            process.submit(os.getpid).result()  # it starts with the first call
        yield process


def _preloaded(folder: Path) -> dict[str, str]:
    if torch.version.cuda is not None:
        if not torch.cuda.is_available():  # its own guard and hooks ask the driver
            raise TrilightError(
                f"a card that is not there: torch {torch.__version__} is built for CUDA, and this "
                "machine has no driver; expected a driver, or torch's CPU build, which "
                "docs/how-to/install.md says how to install."
            )
        return {}
    others = os.environ.get("LD_PRELOAD", "").split()
    return {"LD_PRELOAD": " ".join([str(_compiled(folder)), *others])}


def _compiled(folder: Path) -> Path:
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        raise TrilightError(
            "a card that is not there: no C++ compiler found; expected g++ or c++, which a torch "
            "without CUDA needs for it. Set CXX or install g++."
        )
    torch_folder, library = Path(torch.__file__).parent, folder / "fake_card.so"
    places = [f"-I{torch_folder / 'include'}", f"-L{torch_folder / 'lib'}"]
    found = f"-Wl,-rpath,{torch_folder / 'lib'}"
    command = [compiler, "-std=c++20", "-shared", "-fPIC", *places, found, str(SOURCE)]
    ran = subprocess.run(
        [*command, "-lc10", "-ltorch_cpu", "-o", str(library)],
        capture_output=True,
        text=True,
        check=False,
    )
    if ran.returncode:
        raise TrilightError(
            f"a card that is not there: {compiler} could not compile {SOURCE.name}: "
            f"{ran.stderr.strip()[-400:]}. Expected a compiler of C++20; set CXX to another."
        )
    return library
