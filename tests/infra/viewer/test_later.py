"""Which page shows what, decided before anything slow; and a page that waits for what it shows."""

import threading
from pathlib import Path

import pytest

from infra.viewer.later import LaterRoom, page_of
from infra.viewer.server import NotThere, Question
from storage.errors import TrilightError
from tests.infra.run_by_hand import write_run
from tests.infra.viewer.test_server import EchoRoom


def test_the_page_of_a_source(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    (tmp_path / "set").mkdir()
    with pytest.raises(TrilightError, match="no dataset, and holds no scene"):
        page_of(str(tmp_path / "set"))
    (tmp_path / "set" / "room.glb").touch()
    assert page_of(str(tmp_path / "set")) == "folder.html"
    (tmp_path / "set" / "manifest.json").write_text("{}")
    (tmp_path / "a.tar").touch()
    with pytest.raises(TrilightError, match=r"a training run; .* `tensorboard --logdir /.*/run`"):
        page_of(str(tmp_path / "run"))
    assert page_of(str(tmp_path / "set")) == "dataset.html"
    assert page_of("https://example.org/set") == "dataset.html"
    for scene in ("a.tar", "a.tar::000000000"):
        assert page_of(str(tmp_path / scene)) == "scene.html"
    for missing in ("b.json", "b.tar::1"):
        with pytest.raises(TrilightError, match="no such file"):
            page_of(str(tmp_path / missing))


def test_questions_wait_until_the_source_is_open() -> None:
    later, answers = LaterRoom("scene.html"), list[bytes]()
    assert later.gets[""](Question(path="", query={})).kind.startswith("text/html")
    asked = threading.Thread(
        target=lambda: answers.append(later.gets["api/"](Question(path="api/echo", query={})).body)
    )
    asked.start()
    asked.join(0.05)
    assert asked.is_alive() and not answers
    later.opened.set_result(EchoRoom())
    asked.join(10)
    assert b"api/echo" in answers[0]
    with pytest.raises(NotThere):
        later.posts["api/"](Question(path="api/none", query={}))
