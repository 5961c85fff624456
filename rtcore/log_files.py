"""The log of a process: JSON lines in the run's directory."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

LEVEL_NAMES = {"WARNING": "WARN", "CRITICAL": "ERROR"}  # as in messages.Level


class JsonLines(logging.Formatter):
    """One JSON object a line: ts (UTC), mono_ns, level, process, logger, text and, if any, exception."""

    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """The line, without its end."""
        line = {
            "ts": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "mono_ns": time.monotonic_ns(),
            "level": LEVEL_NAMES.get(record.levelname, record.levelname),
            "process": self._process,
            "logger": record.name,
            "text": record.getMessage(),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line)


class LineFile(logging.FileHandler):
    """Appends to a file, which is opened with the first line and flushed after each.

    Attributes:
        lost: lines that could not be written since the last one that could.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, mode="a", encoding="utf-8", delay=True)
        self.lost = 0
        self._whole = 0  # bytes of the file that are whole lines

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record, and how many before it were lost."""
        try:
            if self.stream is None:
                Path(self.baseFilename).parent.mkdir(parents=True, exist_ok=True)
                self.stream = self._open()
                self._whole = os.fstat(self.stream.fileno()).st_size
            line = self.format(record) + self.terminator
            self.stream.write(self._of_lost(record) + line if self.lost else line)
            self.flush()
            self.lost, self._whole = 0, os.fstat(self.stream.fileno()).st_size
        except OSError as error:
            self._lose(error)
        except (TypeError, ValueError, KeyError):  # arguments that do not fit the text
            self.handleError(record)

    def close(self) -> None:
        """Close the file, whatever its disk says."""
        try:
            super().close()
        except OSError as error:
            self._lose(error)

    def _lose(self, error: OSError) -> None:
        if self.lost == 0:
            with suppress(OSError):  # it may be a file on the same disk
                sys.stderr.write(f"{self.baseFilename}: log lines are lost: {error}\n")
        self.lost += 1
        stream, self.stream = self.stream, None  # with what is in its buffer
        if stream is not None:
            with suppress(OSError):
                stream.close()
            with suppress(OSError):  # the next line must not follow half of one
                os.truncate(self.baseFilename, self._whole)

    def _of_lost(self, record: logging.LogRecord) -> str:
        text = f"{self.lost} log lines were lost before this one"
        told = logging.LogRecord(record.name, logging.WARNING, __file__, 0, text, None, None)
        return self.format(told) + self.terminator


class LogFile:
    """What `log_to_file` set up. Leaving the `with` block, or `close`, takes it down again."""

    def __init__(self, handlers: tuple[logging.Handler, ...], previous_level: int) -> None:
        self._handlers = handlers
        self._previous_level = previous_level

    def close(self) -> None:
        """Stop logging there and close the file. A second close does nothing."""
        root = logging.getLogger()
        for handler in self._handlers:
            root.removeHandler(handler)
            handler.close()
        if self._handlers:
            root.setLevel(self._previous_level)
        self._handlers = ()

    def __enter__(self) -> LogFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def log_to_file(path: Path, process: str, *, level: int = logging.INFO) -> LogFile:
    """Send the process's log to `path` as JSON lines, and warnings and errors to stderr as well.

    Works from the call on; closing the result is for those who log elsewhere afterwards. The file is
    appended to, a line at a time, so that the incarnations of one process share it. A disk that is full or
    read-only costs lines of the file, which are counted there once it can be written again, and nothing else.
    """
    lines = LineFile(path)
    lines.setFormatter(JsonLines(process))
    console = logging.StreamHandler()
    console.setLevel(logging.WARNING)
    console.setFormatter(logging.Formatter(f"{process}: %(levelname)s: %(message)s"))
    root = logging.getLogger()
    handle = LogFile((lines, console), root.level)
    root.setLevel(level)
    root.addHandler(lines)
    root.addHandler(console)
    return handle
