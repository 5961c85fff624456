"""Standard output and errors whose reader may go: a terminal is closed, the other end of a pipe has ended."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, TextIO, cast

GONE = (errno.EPIPE, errno.EIO)  # of a pipe, of a terminal


class _Unread:
    """A text stream that does not complain. What cannot be written is lost; once nobody can read it any
    more, the rest goes nowhere.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write it, or not."""
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Flush, or not."""
        self._try(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _try(self, put: Callable[[], object]) -> None:
        try:
            put()
        except OSError as error:
            if error.errno in GONE:
                self._give_up()

    def _give_up(self) -> None:
        """What the stream still holds would fail once more at the interpreter's end, and be its exit code."""
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


def unread(stream: TextIO) -> TextIO:
    """The stream, for who goes on when nobody reads it any more."""
    return cast("TextIO", _Unread(stream))


@contextmanager
def dispensable() -> Iterator[None]:
    """Inside the block standard output and errors are such streams; those that were closed stay so."""
    out = unread(sys.stdout) if sys.stdout else sys.stdout
    err = unread(sys.stderr) if sys.stderr else sys.stderr
    with redirect_stdout(out), redirect_stderr(err):
        yield
