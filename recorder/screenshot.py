"""`python -m recorder.screenshot RECORDING PICTURE.png`: what a viewer shows, without a screen.

For documents and reports. Needs a graphics driver; a software one will do (Debian and Ubuntu: package
mesa-vulkan-drivers). Takes several seconds of both cores: not beside a run that is being timed.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from rerun.experimental import ViewerClient

from recorder.finish import switch_off_statistics

PORT = 9899
START_S = 20.0
SETTLE_S = 3.0  # loading, and the camera's way to the robot


def main(argv: Sequence[str] | None = None) -> int:
    """Take the picture; 1 if the viewer did not start."""
    parser = argparse.ArgumentParser(prog="python -m recorder.screenshot", description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--at", type=float, metavar="S", help="run time in seconds; default: the end")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="tenuto-") as home:
        switch_off_statistics(Path(home))
        command = [
            sys.executable,
            "-m",
            "rerun_cli",
            "--headless",
            "--hide-welcome-screen",
            "--port",
            str(PORT),
        ]
        environment = {"HOME": home, "XDG_RUNTIME_DIR": home, "RUST_LOG": "error"}
        with subprocess.Popen(command, env=environment, process_group=0) as viewer:
            try:
                png = _picture(arguments.recording.resolve(), arguments.at)
            except (OSError, RuntimeError) as error:
                sys.stderr.write(f"the viewer gives no picture (is there a Vulkan driver?): {error}\n")
                return 1
            finally:
                os.killpg(viewer.pid, signal.SIGKILL)  # the wrapper, and the viewer that it started
    arguments.picture.write_bytes(png)
    return 0


def _picture(recording: Path, at_s: float | None) -> bytes:
    with _connected() as client:
        client.open(str(recording))
        time.sleep(SETTLE_S)
        if at_s is not None:
            client.set_time("run_time", duration=at_s, play_state="paused")
            time.sleep(SETTLE_S)
        return client.take_screenshot()


def _connected() -> ViewerClient:
    deadline = time.monotonic() + START_S
    while True:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{PORT}/proxy")
            client.get_state()
        except (OSError, RuntimeError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
        else:
            return client


if __name__ == "__main__":
    sys.exit(main())
