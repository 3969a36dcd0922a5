"""The way in to what `make serve` started, for the user who started it and for nobody else.

Prefect's commands read `prefect.toml` in the folder where they run. So the server's URL and
password stand in a file of that name among what serving keeps (mode 0600), and in the checkout a
link leads there: every command of the documents works from the checkout with nothing exported, the
password is in no copy of the checkout, and it goes with `make stop`. Where TRILIGHT_STATE names
another folder there is no link, since a second server must not take the commands away from the
first.
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
"""Where Prefect's commands look in the checkout; git ignores it."""


def state_folder() -> Path:
    """Return where serving keeps logs, password and mark: TRILIGHT_STATE, or in the cache."""
    place = os.environ.get("TRILIGHT_STATE")
    return private_folder(Path(place).absolute() if place else cache_folder("serve").absolute())


def settings_file() -> Path:
    """Return the file with the URL and the password of the server."""
    return state_folder() / "prefect.toml"


def grant(url: str) -> dict[str, str]:
    """Write the settings file and its link, and return what servers and clients are told.

    The password is a new one each time, or that of PREFECT_SERVER_API_AUTH_STRING.

    Raises:
        TrilightError: somebody's own prefect.toml is in the checkout, or nothing can be written.
    """
    _require_no_other_link()
    password = os.environ.get(PASSWORD) or new_password()
    text = "\n".join(["[api]", f"url = {_toml(url)}", f"auth_string = {_toml(password)}", ""])
    file = settings_file()
    file.unlink(missing_ok=True)
    with open_private(file, "w") as stream:
        stream.write(text)
    if not os.environ.get("TRILIGHT_STATE"):
        LINK.unlink(missing_ok=True)
        LINK.symlink_to(file)
    return {"PREFECT_API_URL": url, PASSWORD: password, CLIENT_PASSWORD: password}


def revoke() -> None:
    """Remove the settings file and the link that leads there."""
    file = settings_file()
    file.unlink(missing_ok=True)
    if LINK.is_symlink() and LINK.readlink() == file:
        with contextlib.suppress(OSError):
            LINK.unlink()


def next_command() -> str:
    """Return what starts a flow at the server."""
    command = "prefect deployment run generate-scenes/local --watch"
    if not os.environ.get("TRILIGHT_STATE"):
        return command
    return f"cd {shlex.quote(str(state_folder()))} && {command}"


def _require_no_other_link() -> None:
    if LINK.exists() and not LINK.is_symlink() and not os.environ.get("TRILIGHT_STATE"):
        raise TrilightError(
            f"make serve: {LINK} is a file of your own; expected none, because a link to the "
            "server's password goes there. Move its settings to your profile (prefect config set)."
        )


def _toml(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
