"""Processes and their spares, as the supervisor sees them; a shell stands in for a spare."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from launcher.children import Children

NAMES = ("env_server.0", "agent_service.0", "agent_service.1")
AGENT0, AGENT1 = NAMES[1:]
SPARE = ["sh", "-c", 'echo $$ > "$0/spare"; read -r order; echo "$order" > "$0/order"; exec sleep 30']


@contextmanager
def kept(directory: Path) -> Iterator[Children]:
    commands = {name: ["sh", "-c", "exec sleep 30", name] for name in NAMES}
    children = Children(commands, directory, {"agent_service": [*SPARE, str(directory)]})
    with children.kept():
        for name in NAMES:
            assert not children.start(name)
        yield children


def spare(directory: Path, children: Children) -> int:
    """The number of a new one, which waits."""
    (directory / "spare").unlink(missing_ok=True)
    children.tend(math.inf)
    return int(written(directory / "spare"))


def written(path: Path) -> str:
    deadline = time.monotonic() + 10
    while not path.exists() or not path.read_text().endswith("\n"):
        assert time.monotonic() < deadline
        time.sleep(0.002)
    return path.read_text()


def test_a_spare_is_nobody_until_it_becomes_somebody(tmp_path: Path) -> None:
    with kept(tmp_path) as children:
        number = spare(tmp_path, children)
        assert children.running() == set(NAMES)
        children.kill({AGENT1})
        assert children.running() == {NAMES[0], AGENT0}
        assert children.start(AGENT1)
        assert children.pid(AGENT1) == number
        assert children.running() == set(NAMES)
        assert f'"{AGENT1}"' in written(tmp_path / "order")
        assert str(tmp_path / f"{AGENT1}.out") in written(tmp_path / "order")
        os.kill(number, 9)
        children.kill({AGENT1})
        assert children.exits() == {AGENT1: -9}
        assert not children.start(AGENT1)  # from nothing: there is no other spare yet


def test_there_is_none_right_after_a_start(tmp_path: Path) -> None:
    with kept(tmp_path) as children:
        children.tend(time.monotonic())
        children.kill({AGENT0})
        assert not children.start(AGENT0)


def test_who_is_of_another_role_starts_from_nothing(tmp_path: Path) -> None:
    with kept(tmp_path) as children:
        number = spare(tmp_path, children)
        children.kill({NAMES[0]})
        assert not children.start(NAMES[0])
        assert children.pid(NAMES[0]) != number


def test_a_killed_spare_costs_no_start(tmp_path: Path) -> None:
    with kept(tmp_path) as children:
        number = spare(tmp_path, children)
        os.kill(number, 9)
        os.waitid(os.P_PID, number, os.WEXITED | os.WNOWAIT)  # left for its owner to bury
        children.kill({AGENT0})
        assert not children.start(AGENT0)
        assert children.running() == set(NAMES)
        assert children.exits() == {}


def test_spares_end_with_the_block(tmp_path: Path) -> None:
    with kept(tmp_path) as children:
        number = spare(tmp_path, children)
    assert not Path(f"/proc/{number}").exists()
