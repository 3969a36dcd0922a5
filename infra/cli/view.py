"""`trilight view`: serves a local page to look at scenes or a dataset."""

import os
import signal
import sys
import threading
import time
import webbrowser
from concurrent.futures import Future
from typing import Annotated

from infra.cli.console import console, first_words, suggest_look
from infra.cli.options import command
from infra.torch_library import require_torch
from storage.remote.url import safe_url
from storage.settings.described import checked
from storage.settings.ranges import Within

_STOP_S = 0.2
"""Seconds within which Ctrl-C is noticed."""


@checked()
class ViewOptions:
    """Source and page."""

    source: str
    """Scene file, folder of scene files, or dataset (folder or URL)."""
    checkpoint: str | None = None
    """Network to show in addition to the built-in ones; by default none."""
    port: Annotated[int, Within(0, 65_535)] = 0
    """Local port of the page; 0 finds a free one."""
    threads: Annotated[int | None, Within(1, 1024, unit="threads")] = None
    """Number of CPU threads of the path tracer; by default one for each core."""
    no_browser: bool = False
    """Print the address only, and open no browser."""


@command("source", has_json=False)
def view(options: ViewOptions) -> None:
    first_words(f"Opening {safe_url(options.source)}")
    from infra.viewer.open_source import PageHandlers, deferred_routes, open_handlers, page_of
    from infra.viewer.server import PageServer

    if options.checkpoint is not None:
        require_torch("--checkpoint")
    opened = Future[PageHandlers]()
    server = PageServer(deferred_routes(page_of(options.source), opened), port=options.port)
    stops: list[int] = []
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    threading.Thread(target=server.run, daemon=True).start()
    suggest_look(f"Look at {server.address}")
    console.print("Only this machine reaches it, with this address. Ctrl-C ends it.", style="dim")
    screens = ("DISPLAY", "WAYLAND_DISPLAY")  # without one a browser takes over the terminal
    if not options.no_browser and (sys.platform != "linux" or any(map(os.environ.get, screens))):
        webbrowser.open(server.address)
    room = open_handlers(options.source, checkpoint=options.checkpoint, threads=options.threads)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stops.append(number))
    opened.set_result(room)
    while not stops:  # no lock: a signal just before a wait without end would be seen after it
        time.sleep(_STOP_S)
    room.close()
    server.close()
    console.print("Ended.", style="dim")
