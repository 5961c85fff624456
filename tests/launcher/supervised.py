"""A supervisor in a process of its own, for tests that send it signals: python supervised.py DIRECTORY.

Exits as `tenuto run` does: 0, 1 after a failure, 130 when killed.
"""

from __future__ import annotations

import sys
from pathlib import Path

from launcher.supervisor import Interrupts, Supervisor
from tests.launcher.test_supervisor import children


def main(directory: Path) -> int:
    interrupts = Interrupts()
    supervisor = Supervisor(children(directory, {"learner": ["stubborn"]}), directory)
    with interrupts.counted(), supervisor.started():
        end = supervisor.supervise(interrupts, lambda waiting_for: None)
    return 130 if end.reason == "killed" else int(bool(end.failures or end.forced))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
