"""Access to the server of `make serve`, for the user who started it only.

Prefect's commands read `prefect.toml` in the folder where they run. So the server's URL and
password are in a file of that name in the state folder (mode 0600), and the checkout holds a link
to it: every command of the documents works from the checkout without exported variables, no copy of
the checkout holds the password, and `make stop` deletes it. If TRILIGHT_STATE names another state
folder, there is no link, since a second server must not take the commands away from the first.
"""

import contextlib
import json
import os
import shlex
from pathlib import Path

from pipeline.flows.prefect_server import CLIENT_PASSWORD, PASSWORD, new_password
from storage.cache import cache_folder, open_private, private_folder
from storage.errors import TrilightError
from storage.installation import FILES_ROOT

ROOT = FILES_ROOT
LINK = ROOT / "prefect.toml"
"""Link in the checkout that Prefect's commands read; git ignores it."""


def state_folder() -> Path:
    """Return the folder of logs, password and mark: TRILIGHT_STATE, or one in the cache."""
    place = os.environ.get("TRILIGHT_STATE")
    return private_folder(Path(place).absolute() if place else cache_folder("serve").absolute())


def settings_file() -> Path:
    """Return the file with the URL and the password of the server."""
    return state_folder() / "prefect.toml"


def grant(url: str) -> dict[str, str]:
    """Write the settings file and its link; return the environment of server and clients.

    The password is a new one each time, or that of PREFECT_SERVER_API_AUTH_STRING.

    Raises:
        TrilightError: the checkout holds a prefect.toml of the user, or a file cannot be written.
    """
    if LINK.exists() and not LINK.is_symlink() and not os.environ.get("TRILIGHT_STATE"):
        raise TrilightError(
            f"make serve: {LINK} is a file of your own; expected none, because a link to the "
            "server's password goes there. Move its settings to your profile (prefect config set)."
        )
    password = os.environ.get(PASSWORD) or new_password()
    quoted = [json.dumps(each, ensure_ascii=False) for each in (url, password)]  # as TOML does
    text = "[api]\nurl = {}\nauth_string = {}\n".format(*quoted)
    file = settings_file()
    file.unlink(missing_ok=True)
    with open_private(file, "w") as stream:
        stream.write(text)
    if not os.environ.get("TRILIGHT_STATE"):
        LINK.unlink(missing_ok=True)
        LINK.symlink_to(file)
    return {"PREFECT_API_URL": url, PASSWORD: password, CLIENT_PASSWORD: password}


def revoke() -> None:
    """Delete the settings file and its link."""
    file = settings_file()
    file.unlink(missing_ok=True)
    if LINK.is_symlink() and LINK.readlink() == file:
        with contextlib.suppress(OSError):
            LINK.unlink()


def next_command() -> str:
    """Return the command that starts a flow on the server."""
    command = "prefect deployment run generate-scenes/local --watch"
    if not os.environ.get("TRILIGHT_STATE"):
        return command
    return f"cd {shlex.quote(str(state_folder()))} && {command}"
