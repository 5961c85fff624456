"""A recording whose recorder did not live to complete it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

from launcher.supervisor import Interrupts

LIMIT_S = 20.0
# Who interrupted waits 5 s for all of it: of the rest, 0.2 s are for the tool to end what it has started,
# and 0.3 s for the report.
INTERRUPTED_LIMIT_S = 4.5
COMPACT_SHARE = 0.6  # of the time: joining what is not compacted by then may take half as long again
ENDING_S = 0.2
POLL_S = 0.05


def mend(recording: Path, interrupts: Interrupts) -> bool:
    """Merge the parts that the recorder's lives left, and repair a torn end; complain if that fails. Of a
    recording that is too long for that the parts are joined as they are.

    It is the recorder's own tool, in a process of its own: the launcher needs none of its libraries. It has
    20 s; once somebody has interrupted, until 4.5 s after that; and if they do it twice, no time at all.
    """
    if not any(recording.parent.glob(f"*{recording.stem}*.rrd")):
        return False  # neither it nor a part of it
    begin_s = time.monotonic()
    within_s = COMPACT_SHARE * max(0.0, _due_s(begin_s, interrupts) - begin_s)
    command = [sys.executable, "-m", "recorder.finish", "--within-s", f"{within_s:.2f}", str(recording)]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, process_group=0
    ) as tool:
        output = None
        while output is None and not _over(begin_s, interrupts):
            output = _waited(tool, POLL_S)
        if output is None:
            tool.send_signal(signal.SIGINT)  # it then ends what it has started itself
            if _waited(tool, ENDING_S) is None:
                tool.kill()
            output = b"it takes too long"
    if tool.returncode == 0:
        return True
    lines = output.decode(errors="replace").strip().splitlines() or ["no output"]
    sys.stderr.write(
        f"tenuto: the recording is not completed ({lines[-1]}); to complete it: "
        f"python -m recorder.finish {recording}\n"
    )
    return False


def _due_s(begin_s: float, interrupts: Interrupts) -> float:
    return min(begin_s + LIMIT_S, interrupts.first_s + INTERRUPTED_LIMIT_S)


def _over(begin_s: float, interrupts: Interrupts) -> bool:
    return time.monotonic() >= _due_s(begin_s, interrupts) or interrupts.count > 1


def _waited(tool: subprocess.Popen[bytes], timeout_s: float) -> bytes | None:
    """What it printed, if it ends within the time; called again, all of it."""
    try:
        return tool.communicate(timeout=timeout_s)[0]
    except subprocess.TimeoutExpired:
        return None
