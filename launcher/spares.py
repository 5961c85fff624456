"""Processes in reserve: loaded, waiting for the order to be the next life of a process of their role.

Most of an agent's start is loading, and nobody acts meanwhile.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

# After a start in its role: a spare takes 0.25 s of a core to load, which who has just been started needs,
# and at a run's beginning everybody.
SETTLED_S = 3.0
RETRY_S = 60.0  # after a spare that died by itself: the next one may, too


class Spares:
    """One waiting process for each of some roles."""

    def __init__(self, roles: Collection[str], start: Callable[[str], subprocess.Popen[bytes]]) -> None:
        """Args:
        roles: of which there is to be one.
        start: starts one, with a pipe as its stdin.
        """
        self._start = start
        self._waiting: dict[str, subprocess.Popen[bytes]] = {}
        self._due_s = dict.fromkeys(roles, 0.0)  # not before

    def began(self, role: str, now_s: float) -> None:
        """A process of that role was started."""
        if role in self._due_s:
            self._due_s[role] = max(self._due_s[role], now_s + SETTLED_S)

    def tend(self, now_s: float) -> None:
        """Start what is missing, when it is time. To be called many times a second."""
        for role, due_s in self._due_s.items():
            spare = self._waiting.get(role)
            if spare is not None and spare.poll() is not None:
                _end(self._waiting.pop(role))
                self._due_s[role] = now_s + RETRY_S
            elif spare is None and now_s >= due_s:
                try:
                    self._waiting[role] = self._start(role)
                except OSError:  # no memory, no file descriptors: that may pass
                    self._due_s[role] = now_s + RETRY_S

    def take(self, role: str, command: Sequence[str], output: Path) -> subprocess.Popen[bytes] | None:
        """Have the spare become a process.

        Args:
            role: of the process.
            command: its command line.
            output: the file for what it prints.

        Returns:
            The process; None: there is no living spare.
        """
        spare = self._waiting.pop(role, None)
        if spare is None:
            return None
        assert spare.stdin is not None
        order = json.dumps({"command": list(command), "output": str(output)})
        try:
            with spare.stdin:
                spare.stdin.write(order.encode() + b"\n")
        except OSError:  # it has died
            _end(spare)
            return None
        return spare

    def end(self) -> None:
        """Those that still wait."""
        while self._waiting:
            _end(self._waiting.popitem()[1])


def _end(spare: subprocess.Popen[bytes]) -> None:
    with spare:  # closes the pipe, and waits
        spare.kill()
