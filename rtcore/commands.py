"""Both ends of a command: what the two buses share of `serve` and `ask`."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

import msgspec

from rtcore.admission import check_command
from rtcore.bus import NoAnswerError
from rtcore.codec import Rejections
from rtcore.messages import Command, CommandReply

CONTROL = "control"  # under this name refused commands and replies are counted
MAX_BYTES = 65_536
REMEMBERED = 256  # replies kept for repeated ids; a client repeats within seconds

_T = TypeVar("_T")

_encode = msgspec.msgpack.Encoder().encode


class CommandServer:
    """Answers encoded commands: each id is carried out once, whatever the handler does."""

    def __init__(self, handler: Callable[[Command], CommandReply], rejections: Rejections) -> None:
        self._handler = handler
        self._rejections = rejections
        self._decoder = msgspec.msgpack.Decoder(Command)
        self._replies: OrderedDict[str, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def answer(self, payload: bytes) -> bytes | None:
        """The encoded reply; None (and one more on the count) if the payload is not a command."""
        command = _decode(self._decoder, payload, self._rejections, check_command)
        if command is None:
            return None
        with self._lock:  # a repeat waits for the first reply
            reply = self._replies.get(command.id)
            if reply is None:
                reply = _encode(self._carry_out(command))
                self._replies[command.id] = reply
                if len(self._replies) > REMEMBERED:
                    self._replies.popitem(last=False)
        return reply

    def _carry_out(self, command: Command) -> CommandReply:
        try:
            reply = self._handler(command)
        except Exception as error:
            logging.getLogger(__name__).warning("command %s failed", command.verb, exc_info=True)
            return CommandReply(id=command.id, ok=False, text=f"{type(error).__name__}: {error}")
        return msgspec.structs.replace(reply, id=command.id)


class CommandClient:
    """Encodes a command and recognises its reply."""

    def __init__(self, command: Command, rejections: Rejections) -> None:
        self.payload = _encode(command)
        self._command = command
        self._rejections = rejections
        self._decoder = msgspec.msgpack.Decoder(CommandReply)

    def accept(self, payload: bytes) -> CommandReply | None:
        """The reply to this command; None (and one more on the count) if the payload is none."""
        reply = _decode(self._decoder, payload, self._rejections)
        if reply is not None and reply.id != self._command.id:
            self._rejections.count(CONTROL, f"a reply to {reply.id!r} where {self._command.id!r} was asked")
            return None
        return reply

    def no_answer(self, name: str, timeout_s: float, tries: int) -> NoAnswerError:
        """What to raise when nobody answered."""
        times = "1 try" if tries == 1 else f"{tries} tries"
        return NoAnswerError(
            f"{name} did not answer {self._command.verb!r}: {times} of up to {timeout_s:g} s"
        )


def _accept(_message: object) -> None:
    """Every reply that decodes."""


def _decode(
    decoder: msgspec.msgpack.Decoder[_T],
    payload: bytes,
    rejections: Rejections,
    check: Callable[[_T], None] = _accept,
) -> _T | None:
    if len(payload) > MAX_BYTES:
        rejections.count(CONTROL, f"{len(payload)} bytes: at most {MAX_BYTES} allowed")
        return None
    try:
        message = decoder.decode(payload)
        check(message)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        rejections.count(CONTROL, error)
        return None
    return message
