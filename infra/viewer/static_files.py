"""Static files of the pages: scripts, styles and three.js, all from the package.

They are listed when the server starts, so that a request's path only selects from a list.
"""

from pathlib import Path

from infra.viewer.server import NotFound, Request, Response, Route

STATIC = Path(__file__).with_name("static")

_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    "": "text/plain; charset=utf-8",
}


def static_routes(page: str) -> dict[str, Route]:
    """Return the routes of the files below `static/`, and of the page at the root."""
    files = {
        path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*") if path.is_file()
    }

    def file(request: Request) -> Response:
        name = request.path.removeprefix("static/")
        if name not in files:
            raise NotFound("there is no such file.")
        return Response(body=files[name].read_bytes(), kind=_KINDS[files[name].suffix])

    def index(request: Request) -> Response:
        return Response(body=files[page].read_bytes(), kind=_KINDS[".html"])

    return {"": index, "static/": file}
