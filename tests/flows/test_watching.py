"""Where the report page is said to be: below a public address, or as the user named the folder."""

import pytest

from pipeline.flows.served.watching import _report_url


@pytest.mark.parametrize(
    ("base", "url"),
    [
        ("", "data/mine/report.html"),
        ("https://data.example/sets/", "https://data.example/sets/mine/report.html"),
    ],
)
def test_the_link_to_the_report(monkeypatch: pytest.MonkeyPatch, base: str, url: str) -> None:
    monkeypatch.setenv("TRILIGHT_PUBLIC_URL", base)
    assert _report_url("data/mine") == url
