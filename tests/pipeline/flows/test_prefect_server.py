"""A port that another program took in between is one line, whatever it speaks."""

import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pipeline.flows.prefect_server import wait_until_healthy
from storage.errors import TrilightError


def test_an_answer_that_is_no_http_is_not_our_server(tmp_path: Path) -> None:
    """Seen once: a Dask scheduler answered, and the start ended in a traceback."""
    ending = [sys.executable, "-c", "import time; time.sleep(0.5)"]
    with socket.create_server(("127.0.0.1", 0)) as listener, subprocess.Popen(ending) as server:

        def answer() -> None:
            while True:
                try:
                    connection, _ = listener.accept()
                except OSError:
                    return
                with connection:
                    connection.sendall(b":\x00\x00\x00\x00compression\n\n")

        threading.Thread(target=answer, daemon=True).start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with pytest.raises(TrilightError, match="did not start"):
            wait_until_healthy(url, server, tmp_path / "server.log")
