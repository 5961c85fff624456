"""The live view of a run: a Rerun viewer on the stream that the recorder offers."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

from rtcore.config import RecorderConfig

HOST = "127.0.0.1"
WEB_PORT = 9090


class Viewer:
    """One viewer process: a window, which stays when the run ends, or a server for the browser."""

    def __init__(self, config: RecorderConfig, output: Path) -> None:
        self._config = config
        self._output = output
        self._process: subprocess.Popen[bytes] | None = None
        self._opened = False

    @property
    def due(self) -> bool:
        """Whether a view is wanted and was not opened yet."""
        return self._config.record and self._config.view != "none" and not self._opened

    @property
    def address(self) -> str:
        """What a person opens."""
        stream = f"rerun+http://{HOST}:{self._config.port}/proxy"
        if self._config.view == "native":
            return stream
        return f"http://{HOST}:{WEB_PORT}/?url={quote(stream, safe='')}"

    def command(self) -> list[str]:
        """The viewer's command line. It is a program of its own: the recorder alone imports its library."""
        stream = f"rerun+http://{HOST}:{self._config.port}/proxy"
        web = ["--web-viewer", "--bind", HOST, "--web-viewer-port", str(WEB_PORT)]
        return [sys.executable, "-m", "rerun", *(web if self._config.view == "web" else []), stream]

    def open(self) -> None:
        """Start it, out of reach of the terminal's Ctrl-C; call when the recorder is there."""
        self._opened = True
        with self._output.open("ab") as output:
            self._process = subprocess.Popen(
                self.command(),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                process_group=0,
            )

    def close(self) -> None:
        """End the browser's server with the run; a window is the person's to close."""
        if self._process is not None and self._config.view == "web":
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # the group: python starts the viewer as a child
            self._process.wait()
