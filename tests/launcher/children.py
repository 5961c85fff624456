"""Real processes that stand in for the four: what they do is told by their arguments.

    python children.py NAME DIRECTORY [obedient | stubborn | ends CODE]

`ends` waits until all four are ready. Each writes DIRECTORY/NAME.ready once its handlers are in place,
and a line into DIRECTORY/ended.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from types import FrameType

LIFETIME_S = 30.0  # so that nothing outlives a broken test


def main(name: str, directory: Path, behaviour: str, code: str = "0") -> None:
    def obey(number: int, frame: FrameType | None) -> None:
        finish(name, directory, 0)

    # The terminal's Ctrl-C must not reach a child: one that gets it would be found out by its exit code.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_IGN if behaviour == "stubborn" else obey)
    (directory / f"{name}.ready").write_text(str(os.getpid()))
    if behaviour == "ends":
        wait_for_the_others(directory)
        sys.stderr.write(f"{name}: no more\n")
        finish(name, directory, int(code))
    time.sleep(LIFETIME_S)


def wait_for_the_others(directory: Path) -> None:
    while len(list(directory.glob("*.ready"))) < 4:
        time.sleep(0.01)


def finish(name: str, directory: Path, code: int) -> None:
    with (directory / "ended").open("a") as file:
        file.write(f"{name}\n")
    sys.exit(code)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
