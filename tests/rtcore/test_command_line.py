"""A process that shows another command line than the one that it was started with."""

from __future__ import annotations

import subprocess
import sys

SHOWN = """
import sys
from pathlib import Path
from rtcore import command_line

try:
    command_line.replace(sys.argv[1:])
except OSError as error:
    print(error)
print(Path("/proc/self/cmdline").read_bytes(), sys.argv[1:])
"""


def shown(*arguments: str) -> list[str]:
    command = [sys.executable, "-c", SHOWN, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_others_see_the_new_words_and_nothing_of_the_old_ones() -> None:
    words = ["python", "-m", "rôle", "--run", "a b"]
    room = sum(len(word.encode()) + 1 for word in (sys.executable, "-c", SHOWN, *words))
    expected = b"python\0-m\0r\xc3\xb4le\0--run\0a b".ljust(room, b"\0")
    assert shown(*words) == [f"{expected!r} {words!r}"]


def test_a_word_may_be_any_bytes() -> None:
    command: list[str | bytes] = [sys.executable, "-c", SHOWN, b"/r\xff"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith(repr(b"/r\xff\0")[:-1])


def test_what_has_no_room_changes_nothing() -> None:
    code = "import sys; from rtcore import command_line; command_line.replace(['x' * 10_000])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "OSError: a command line of 10001 bytes has no room in " in done.stderr
