"""A recording whose recorder did not live to complete it."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

LIMIT_S = 20.0
HURRIED_LIMIT_S = 1.5  # somebody waits for the end


def mend(recording: Path, *, hurried: bool) -> bool:
    """Merge the parts that the recorder's lives left, and repair a torn end; complain if that fails.

    It is the recorder's own tool, in a process of its own: the launcher needs none of its libraries.
    """
    if not recording.exists():
        return False
    command = [sys.executable, "-m", "recorder.finish", str(recording)]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, process_group=0
    ) as tool:
        try:
            output, _ = tool.communicate(timeout=HURRIED_LIMIT_S if hurried else LIMIT_S)
        except subprocess.TimeoutExpired:
            tool.send_signal(signal.SIGINT)  # it then ends what it has started itself
            tool.communicate()
            output = b"it takes too long"
    if tool.returncode == 0:
        return True
    lines = output.decode(errors="replace").strip().splitlines() or ["no output"]
    sys.stderr.write(
        f"tenuto: the recording is as the recorder left it ({lines[-1]}); to complete it: "
        f"python -m recorder.finish {recording}\n"
    )
    return False
