"""Output that nobody reads any more."""

from __future__ import annotations

import errno
import io
import os
import sys

import pytest
from rich.console import Console

from launcher.screen import Screen
from launcher.streams import dispensable, unread
from rtcore.clock import VirtualClock
from tests.launcher.ledgers import CONFIG
from tests.launcher.test_screen import SECOND, watched


def read_until(word: bytes, file: int) -> None:
    shown = b""
    while word not in shown:
        shown += os.read(file, 100_000)


def test_the_screen_goes_on_when_its_terminal_is_gone() -> None:
    terminal, ours = os.openpty()
    with os.fdopen(ours, "w") as file:  # what it still holds costs its close nothing
        console, clock = Console(file=unread(file), force_terminal=True, width=100), VirtualClock(2 * SECOND)
        screen = Screen(console, CONFIG, "r1", watched(), clock)
        with screen.shown():
            screen.update()
            read_until(b"missed", terminal)
            os.close(terminal)
            for _ in range(3):
                clock.advance_ns(SECOND)
                screen.update()
                screen.say("something")
        console.print("the report")


def test_a_pipe_whose_other_end_has_gone_takes_everything() -> None:
    there, here = os.pipe()
    with os.fdopen(here, "w") as file:
        console = Console(file=unread(file))
        console.print("one")
        assert os.read(there, 100) == b"one\n"
        os.close(there)
        console.print("two")
        assert unread(file).write("three") == 5
        unread(file).flush()


def test_a_full_disk_costs_what_it_did_not_take() -> None:
    class Full(io.StringIO):
        full = True

        def write(self, text: str) -> int:
            if self.full:
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(text)

    file = Full()
    stream = unread(file)
    stream.write("lost")
    file.full = False
    stream.write("there")
    assert file.getvalue() == "there"


def test_streams_are_as_before_afterwards_and_closed_ones_stay_so(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", None)
    with dispensable():
        print("said")
        assert sys.stdout is not out
        assert sys.stderr is None
    assert sys.stdout is out
    assert out.getvalue() == "said\n"
