"""Runs a program for a flow, and passes the flow's end on to it, so that it can save."""

import signal
import subprocess
from collections.abc import Callable, Sequence

from pipeline.flows.prefect_server import STOPPED_BY_PARENT
from pipeline.isolation import die_with_parent
from storage.installation import child_environment
from storage.remote.safe_url import safe_text


def run_to_end(command: Sequence[str], say: Callable[[str], None]) -> tuple[int, str]:
    """Run a program and pass on its output.

    If this call ends early (a canceled flow gets SIGTERM, which Prefect raises as an exception),
    the program gets one SIGTERM, and the call waits for it. It has a session of its own, so that no
    signal to the group of this process reaches it too: training ends at once after a second signal.
    If this process is killed, the program is too.

    Args:
        command: program and arguments.
        say: called with each line of the output, without secrets.

    Returns:
        The exit status of the program, and its last line.
    """
    last = ""
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**child_environment(), STOPPED_BY_PARENT: "1"},
        start_new_session=True,
        preexec_fn=die_with_parent,
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if line.strip():
                    last = safe_text(line.strip())
                    say(last)
        except BaseException:
            process.send_signal(signal.SIGTERM)
            process.communicate()  # a full pipe would stop it before it has saved
            raise
    return process.returncode, last
