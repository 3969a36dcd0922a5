"""`index.html` of a run: all that its folder tells, on one page without server, script or net."""

from pathlib import Path

from infra.run_page import sections
from infra.run_page.record import RunRecord, read_record, unreadable
from pipeline.documents.html import element, joined, page
from storage.atomic import write_atomically

_STYLE = """
:root { --c0: #3b6ea5; --c1: #d08a1c; --c2: #4c8f5e; --c3: #9a5bab; --c4: #777; --c5: #c8443f;
  --c6: #2f98a0; --c7: #7a6650; --c8: #b0528a }
@media (prefers-color-scheme: dark) { :root { --c0: #6fa4dd; --c1: #e3aa4d; --c2: #7cbd8d;
  --c3: #c290d2; --c4: #a5a5a5; --c5: #ec7b76; --c6: #5cc5cd; --c7: #b39f86; --c8: #df8dbb } }
nav { display: flex; flex-wrap: wrap; gap: .2rem 1rem; margin: 1rem 0 }
.skip { position: absolute; left: -99rem } .skip:focus { position: static }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 23rem), 1fr));
  gap: 1.4rem 2rem }
figure { margin: 0; min-width: 0 } figcaption { font-size: .9rem; line-height: 1.4 }
svg { display: block; width: 100%; height: auto; overflow: visible }
svg text { font: 13px system-ui, sans-serif; fill: var(--soft) }
.rule { stroke: var(--rule); fill: none }
.line { fill: none; stroke-width: 1.6; stroke: currentColor }
.band { fill: currentColor; opacity: .18 } .area { fill: currentColor; opacity: .85 }
.dot { fill: currentColor } .mark { fill: var(--c5) }
.spike { color: var(--c5) } .tip { fill: transparent }
.tip:hover { fill: var(--soft); fill-opacity: .15 } .heat rect { fill: var(--c0) }
.c0 { color: var(--c0) } .c1 { color: var(--c1) } .c2 { color: var(--c2) } .c3 { color: var(--c3) }
.c4 { color: var(--c4) } .c5 { color: var(--c5) } .c6 { color: var(--c6) } .c7 { color: var(--c7) }
.c8 { color: var(--c8) } .line.faint, i.faint { color: var(--soft) }
.line.faint { stroke-dasharray: 5 4 }
.legend { display: flex; flex-wrap: wrap; gap: 0 .9rem; color: var(--soft); font-size: .85rem }
.legend i { display: inline-block; width: .8em; height: .8em; margin-right: .35em;
  background: currentColor; border-radius: 2px; vertical-align: -.05em }
details { font-size: .85rem } .scroll { overflow-x: auto }
.film { display: flex; gap: .5rem; overflow-x: auto; padding-bottom: .5rem }
.film figure { flex: none }
.film img { display: block; width: 112px; image-rendering: pixelated; background: #111 }
@media (min-width: 30rem) { .nowrap { white-space: nowrap } }
.film figcaption { white-space: nowrap; font-size: .8rem; color: var(--soft) }
pre { columns: 22rem; font-size: .8rem; line-height: 1.45; padding: .7rem;
  white-space: pre-wrap; overflow-wrap: anywhere }
"""

_SECTIONS = {
    "curves": sections.curves,
    "pictures": sections.pictures,
    "layers": sections.layers,
    "spikes": sections.spikes,
    "notes": sections.notes,
    "settings": sections.settings,
}
"""What makes each section, by the name that links to it."""


def write_run_page(root: Path) -> Path:
    """Write the page into the folder of a run, and return its path.

    Raises:
        TrilightError: the folder holds no run, a file of it is damaged, or it cannot be written.
    """
    record = read_record(root)
    try:
        data = _encoded(record)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        # a folder from elsewhere may hold anything
        raise unreadable(root, error) from error
    write_atomically(record.folder.page, data)
    return record.folder.page


def _encoded(record: RunRecord) -> bytes:
    title = f"Run {record.settings.get('run', record.folder.root.name)}"
    links = [element("a", name, href=f"#{name}") for name in _SECTIONS]
    parts = [
        element("a", "To the curves", href="#curves", class_="skip"),
        element("h1", title),
        sections.overview(record),
        element("nav", *links, **{"aria-label": "sections"}),
    ]
    for name, made in _SECTIONS.items():
        parts += [element("h2", name.capitalize(), id=name), made(record)]
    return page(title, element("main", joined(parts)), style=_STYLE)
