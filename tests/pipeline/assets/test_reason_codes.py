"""No reason code without a test that earns it."""

import re

from tests.conftest import ROOT

_RAISED = re.compile(r'Rejected\(\s*"([a-z_]+)"')
_FAILED = re.compile(r'ChildFailed\(\s*f?"([a-z_]+?)(?:_\{|")')
_ANSWERED = re.compile(r'encode_error\("((?!rejected)[a-z_]+)"')
_CHOSEN = re.compile(r'reason = "([a-z_]+)" if [^\n]+ else "([a-z_]+)"')


def codes() -> set[str]:
    """Return every reason that the stage or its children can give, as their sources have them."""
    found: set[str] = set()
    for path in (ROOT / "pipeline" / "assets").rglob("*.py"):
        text = path.read_text()
        found.update(_RAISED.findall(text))
        found.update(code for pair in _CHOSEN.findall(text) for code in pair)
    isolation = "".join(p.read_text() for p in (ROOT / "pipeline" / "isolation").glob("*.py"))
    found.update(_FAILED.findall(isolation))
    found.update(_ANSWERED.findall(isolation))
    return found


def test_the_list_is_read_from_the_sources() -> None:
    known = {"no_faces", "index_range", "parts_lost", "timeout_cpu", "crashed_signal", "exception"}
    assert known < codes()
    assert len(codes()) > 35


def test_every_code_is_named_by_a_test() -> None:
    texts = [
        path.read_text()
        for folder in ("pipeline", "extremes")
        for path in (ROOT / "tests" / folder).rglob("test_*.py")
        if path.name != "test_reason_codes.py"
    ]
    named = {code for code in codes() if any(re.search(rf"\b{code}(\b|_\d)", t) for t in texts)}
    assert codes() - named == set()
