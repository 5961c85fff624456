from __future__ import annotations

from pathlib import Path

import pytest

from launcher.viewer import Viewer
from rtcore.config import RecorderConfig


def viewer(tmp_path: Path, **settings: object) -> Viewer:
    return Viewer(RecorderConfig(port=9911, **settings), tmp_path / "viewer.out")  # type: ignore[arg-type]


def test_a_window_opens_the_recorders_stream(tmp_path: Path) -> None:
    native = viewer(tmp_path, view="native")
    assert native.address == "rerun+http://127.0.0.1:9911/proxy"
    assert native.command()[1:] == ["-m", "rerun", native.address]


def test_the_browser_gets_a_page_of_this_machine_alone(tmp_path: Path) -> None:
    web = viewer(tmp_path, view="web")
    assert web.address == "http://127.0.0.1:9090/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A9911%2Fproxy"
    command = web.command()
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert command[-1] == "rerun+http://127.0.0.1:9911/proxy"


@pytest.mark.parametrize(
    ("record", "view", "due"),
    [(True, "web", True), (True, "native", True), (True, "none", False), (False, "web", False)],
)
def test_it_is_opened_only_where_wanted(record: bool, view: str, due: bool, tmp_path: Path) -> None:
    assert viewer(tmp_path, record=record, view=view).due is due


def test_closing_what_was_never_opened_does_nothing(tmp_path: Path) -> None:
    viewer(tmp_path, view="web").close()
