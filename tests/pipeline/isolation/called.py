"""What the tests of this folder call in children; it imports little, for each child imports it."""

import ctypes
import os
import signal
import stat
import threading
import time
from pathlib import Path

from storage.errors import Rejected, TrilightError


def prepare(folder: str) -> None:
    """Leave a file that counts this process."""
    (Path(folder) / f"started-{os.getpid()}").touch()


def double(value: int) -> int:
    return 2 * value


def length_of(data: bytes) -> int:
    return len(data)


def process_id() -> int:
    return os.getpid()


def reject() -> None:
    raise Rejected("no_faces", "nothing there")


def mistake() -> None:
    raise TrilightError("output: cannot be written.")


def divide() -> float:
    return 1 / 0


def lie() -> int:
    return "seven"  # type: ignore[return-value]


def anything() -> object:
    return 1


def large() -> bytes:
    return bytes(range(256)) * (52 << 10)


def crash() -> None:
    ctypes.string_at(0)


def eat_memory() -> int:
    return len(bytearray(8 << 30))


def hang() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])  # as stubborn as native code
    time.sleep(60)


def burn(seconds: float) -> int:
    """Use processor time, and none of it waiting."""
    start = time.process_time()
    while time.process_time() - start < seconds:
        pass
    return os.getpid()


def wait_for(path: str) -> int:
    while not Path(path).exists():
        time.sleep(0.02)
    return os.getpid()


def die_by(number: int) -> None:
    if number != signal.SIGKILL:  # tests under nohup have children that ignore SIGHUP
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def count_and_die(folder: str, number: int, times: int) -> int:
    """End this process by a signal in the first `times` calls; return how many there were."""
    calls = len(list(Path(folder).iterdir())) + 1
    (Path(folder) / f"call-{calls}").touch()
    if calls <= times:
        os.kill(os.getpid(), number)
    return calls


def fail_set_up(folder: str) -> None:
    count_and_die(folder, 0, 0)
    raise ModuleNotFoundError("a library is broken")


def is_socket(file: int) -> bool:
    try:
        return stat.S_ISSOCK(os.fstat(file).st_mode)
    except OSError:
        return False


def taken_over(pieces: list[bytes], pause_s: float) -> int:
    """Write to whatever leads out of this process, in place of an answer."""
    for file in filter(is_socket, range(3, 40)):
        for piece in pieces:
            os.write(file, piece)
            time.sleep(pause_s)
    time.sleep(60)
    return 0


def deaf(answer: bytes) -> int:
    """Answer, then read nothing more."""
    os.write(next(filter(is_socket, range(3, 40))), answer)
    time.sleep(60)
    return 0


def read(path: Path) -> str:
    return path.read_text()


def write(path: Path) -> None:
    path.write_text("written")


def replace(path: Path, by: Path) -> None:
    os.replace(by, path)


def refused_paths(paths: list[Path], writing: bool) -> list[Path]:
    """Return those of the files that may not be read, or written."""
    refused = []
    for path in paths:
        try:
            path.write_text("written") if writing else path.read_text()
        except PermissionError:
            refused.append(path)
    return refused


def thread() -> int:
    """Return the number of a thread that was started here."""
    numbers: list[int] = []
    started = threading.Thread(target=lambda: numbers.append(threading.get_native_id()))
    started.start()
    started.join()
    return numbers[0]
