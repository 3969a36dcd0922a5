"""What is sent names neither the machine nor its users nor a folder."""

import pytest

from infra.bench.card.private import own_names, without_traces
from tests.for_each import case

REPLACED = [
    ("llvm_ad_rgb, /usr/lib/x86_64/libLLVM.so.19", "llvm_ad_rgb, <path>"),
    ("/srv/anna/My work/x.so: cannot open", "<path>: cannot open"),
    ("C:\\Users\\anna\\cache", "<path>"),
    ("~/.cache/trilight", "<path>"),
    ("anna@annas-box", "<name>@<name>"),
    ("Anna and savannah", "<name> and savannah"),
    ("void at::native::foo<float, 4>(int)", "void at::native::foo<float, 4>(int)"),
    ("99 dB, 1/2 GiB/s, 2 cores", "99 dB, 1/2 GiB/s, 2 cores"),
]  # fmt: skip


def test_paths_and_names_are_replaced() -> None:
    for text, left in REPLACED:
        with case(text):
            found = without_traces({"a": [text], "b": 1.5, "c": None}, ("annas-box", "anna"))
            assert found == {"a": [left], "b": 1.5, "c": None}


def test_own_names_are_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.node", lambda: "node17.cluster.example")
    monkeypatch.setenv("USER", "anna")
    monkeypatch.setenv("SUDO_USER", "root")
    names = own_names()
    assert {"node17.cluster.example", "node17", "anna"} <= set(names) and "root" not in names
    assert list(names) == sorted(names, key=len, reverse=True), "the whole before its part"
