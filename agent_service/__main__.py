"""`python -m agent_service --run DIR`: act until stopped.

While no agent acts, the world goes on with its fallback, so this process is in a hurry.
"""

from __future__ import annotations

import gc
import os
import sys


def main() -> int:
    """Load, then serve; returns the exit code."""
    # NumPy's second thread is never used by products this small, but computes idly for the first 80 ms.
    os.putenv("OPENBLAS_NUM_THREADS", "1")
    gc.disable()  # `realtime.enter` freezes what is loaded until then
    from agent_service.serving import serve
    from rtcore import channels
    from rtcore.process import run_process

    return run_process(channels.AGENT, serve)


if __name__ == "__main__":
    sys.exit(main())
