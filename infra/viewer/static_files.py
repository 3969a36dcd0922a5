"""Files of the pages: scripts, styles and three.js, all from the package and none from elsewhere.

They are listed when the server starts, so that a path of a request only ever chooses from a list.
"""

from pathlib import Path

from infra.viewer.server import Answer, NotThere, Question, Route

STATIC = Path(__file__).with_name("static")

_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    "": "text/plain; charset=utf-8",
}


def static_routes(page: str) -> dict[str, Route]:
    """Return the routes of the files below `static/`, and of a page at the address itself."""
    files = {
        path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*") if path.is_file()
    }

    def file(question: Question) -> Answer:
        name = question.path.removeprefix("static/")
        if name not in files:
            raise NotThere("there is no such file.")
        return Answer(body=files[name].read_bytes(), kind=_KINDS[files[name].suffix])

    def index(question: Question) -> Answer:
        return Answer(body=files[page].read_bytes(), kind=_KINDS[".html"])

    return {"": index, "static/": file}
