"""What Zenoh refused on secured links, from what it logs. Pure: lines in, refusals out.

Zenoh (1.10) has no counter of it and no hook. Links are refused at WARN. Messages are refused at TRACE,
where it also logs what it allows, and whenever a peer first names a key all that the peer could do with it,
done or not: those lines are told apart here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

LOG_FILTER = "off,zenoh_link_tls=warn,zenoh::net::routing::interceptor::access_control=trace"
ACTIONS = 9  # that Zenoh's access control knows, so lines about each key that is named

_HINT = " Hint: increase the system open file limit."  # it says so of every failed handshake
_COLOURS = re.compile(rb"\x1b\[[0-9;]*m")
_LINE = re.compile(r"\S+ +(WARN|ERROR|DEBUG|TRACE) .*?(ThreadId\(\d+\)) ([\w:]+): (.*)")
_NAMED = re.compile(r"(\w+) on \S*CertCommonName\((.*?)\)\S* is (?:un)?authorized to ")
_REFUSED = re.compile(r"(?:Using cached result: )?(\w+) (?:on \S+ )?is unauthorized to (.*?) on (\S+)")


@dataclass(frozen=True)
class Refusal:
    """A link that was not accepted, or a message that was dropped.

    Attributes:
        kind: "link" or "message".
        text: who was refused what.
    """

    kind: str
    text: str


class Refusals:
    """Reads Zenoh's log as it comes."""

    def __init__(self) -> None:
        self._rest = b""
        self._names: dict[str, str] = {}  # session id -> common name of its certificate
        self._listing: dict[str, int] = {}  # thread -> lines still to come about a key that was named

    def feed(self, data: bytes) -> Iterator[Refusal | bytes]:
        """The refusals in `data`, and as bytes the lines that are not from these parts of Zenoh."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for raw in lines:
            if b" is authorized to " in raw and b"Using cached" in raw:
                continue  # most of them by far
            line = _LINE.fullmatch(_COLOURS.sub(b"", raw).decode(errors="replace"))
            if line is None:
                yield raw + b"\n"
            elif line[3].startswith("zenoh_link_tls"):
                yield Refusal("link", line[4].removesuffix(_HINT))
            elif line[3].endswith("access_control"):
                refused = self._message(line[2], line[4])
                if refused is not None:
                    yield refused
            else:
                yield raw + b"\n"

    def _message(self, thread: str, text: str) -> Refusal | None:
        if "caching permissions for" in text:
            self._listing[thread] = ACTIONS
            return None
        named = _NAMED.match(text)
        if named is not None:
            self._names[named[1]] = named[2]
            if self._listing.get(thread, 0) > 0:
                self._listing[thread] -= 1
                return None
        refused = _REFUSED.match(text)
        if refused is None:
            return None
        who = self._names.get(refused[1], refused[1])
        return Refusal("message", f"{who} may not {refused[2]} on {refused[3]}")
