"""Real processes that stand in for the four: what they do is told by their arguments.

    python children.py NAME DIRECTORY [obedient | stubborn | leaves | ends CODE [LIVES [ALL]]]

`ends` waits until all, four unless told otherwise, are ready; with LIVES, only so many of its lives end by
themselves. `leaves` ends in order once DIRECTORY/NAME.go is there. Each writes its pid into
DIRECTORY/NAME.ready once its handlers are in place, its cores and niceness into DIRECTORY/NAME.lives, a line
per life, and a line into DIRECTORY/ended.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from types import FrameType

LIFETIME_S = 30.0  # so that nothing outlives a broken test


def main(
    name: str, directory: Path, behaviour: str, code: str = "0", lives: str = "1000", everybody: str = "4"
) -> None:
    def obey(number: int, frame: FrameType | None) -> None:
        finish(name, directory, 0)

    # The terminal's Ctrl-C must not reach a child: one that gets it would be found out by its exit code.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_IGN if behaviour == "stubborn" else obey)
    with (directory / f"{name}.lives").open("a") as file:
        file.write(f"{sorted(os.sched_getaffinity(0))} {os.nice(0)}\n")
    life = len((directory / f"{name}.lives").read_text().splitlines())
    (directory / f"{name}.ready").write_text(str(os.getpid()))
    if behaviour == "ends" and life <= int(lives):
        wait_for_the_others(directory, int(everybody))
        sys.stderr.write(f"{name}: no more\n")
        finish(name, directory, int(code))
    end_s = time.monotonic() + LIFETIME_S
    while time.monotonic() < end_s:
        if behaviour == "leaves" and (directory / f"{name}.go").exists():
            finish(name, directory, 0)
        time.sleep(0.01 if behaviour == "leaves" else LIFETIME_S)


def wait_for_the_others(directory: Path, everybody: int) -> None:
    while len(list(directory.glob("*.ready"))) < everybody:
        time.sleep(0.01)


def finish(name: str, directory: Path, code: int) -> None:
    with (directory / "ended").open("a") as file:
        file.write(f"{name}\n")
    sys.exit(code)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
