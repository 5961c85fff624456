"""How `tenuto chaos` ends the run that it started."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from launcher.chaos import command
from launcher.supervisor import Interrupts

# Ends at the second SIGINT, with exit code 130; says that it listens, and at the first one.
STUBBORN = """
import signal, sys, time
def handle(number, frame):
    signal.signal(number, lambda number, frame: sys.exit(130))
    print("once", flush=True)
signal.signal(signal.SIGINT, handle)
print("ready", flush=True)
time.sleep(60)
time.sleep(60)
"""


def test_a_second_ctrl_c_is_passed_on_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "END_LIMIT_S", 20.0)
    interrupts = Interrupts()
    line = [sys.executable, "-E", "-S", "-c", STUBBORN]
    with subprocess.Popen(line, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"ready\n"
        interrupts.count = 1

        def impatient() -> None:
            assert child.stdout is not None
            if child.stdout.readline() == b"once\n":
                interrupts.count = 2

        somebody = threading.Thread(target=impatient)
        somebody.start()
        try:
            assert command._ended(child, interrupts) == 130
        finally:
            child.kill()
            somebody.join()


def test_a_run_that_does_not_end_has_no_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "END_LIMIT_S", 0.2)
    with subprocess.Popen(["sleep", "60"]) as child:
        try:
            assert command._ended(child, Interrupts()) is None
        finally:
            child.kill()
