"""What a broken or hostile process might send: true messages with something wrong about them, and noise."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from rtcore.codec import CRC_BYTES, seal

HUGE = 1 << 62
NASTY: tuple[Any, ...] = (
    None, True, -1, 0, 1, 10**9, 10**15, HUGE, HUGE + 1, (1 << 64) - 1, -(1 << 63),
    float("nan"), float("inf"), -float("inf"), -0.0, 1e300, 1e-300,
    "", "x", "\x00", "é" * 300, "../../etc/passwd", "*", "y" * 5_000,
    b"", b"\x00", b"\xff" * 7, b"\x00\x00\xc0\x7f" * 4, b"\x00\x00\x80\x7f" * 2, b"z" * 5_000,
    [], [[]], [None] * 3, [-1], [HUGE] * 4, {}, {"a": None}, {"x" * 500: 1}, {str(i): i for i in range(600)},
)  # fmt: skip


def nested(rng: random.Random, depth: int) -> bytes:
    """Arrays in arrays, deeper than a stack."""
    return bytes([rng.choice((0x91, 0x81, 0xDC))]) * depth


def replace_one(rng: random.Random, tree: Any) -> Any:
    """The tree with one leaf, or one branch, exchanged for something nasty."""
    if isinstance(tree, list) and tree and rng.random() < 0.9:
        at = rng.randrange(len(tree))
        return [*tree[:at], replace_one(rng, tree[at]), *tree[at + 1 :]]
    if isinstance(tree, dict) and tree and rng.random() < 0.8:
        key = rng.choice(list(tree))
        return {**tree, key: replace_one(rng, tree[key])}
    if isinstance(tree, int) and not isinstance(tree, bool) and rng.random() < 0.5:
        return tree + rng.choice((-1, 1, 7, 1_000, 10**6, 10**15))
    if isinstance(tree, bytes) and tree and rng.random() < 0.5:
        return flipped(rng, tree)
    return rng.choice(NASTY)


def flipped(rng: random.Random, data: bytes) -> bytes:
    """With a few bits the other way."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 4, 32))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def mutate_command(rng: random.Random, true: Sequence[bytes]) -> bytes:
    """A command with something wrong about it, most often; `true` are right ones."""
    payload = rng.choice(true)
    if rng.random() < 0.3:
        return flipped(rng, payload)
    if rng.random() < 0.1:
        return bytes(70_000)
    return msgspec.msgpack.encode(replace_one(rng, msgspec.msgpack.decode(payload)))


class Mutator:
    """Makes one bad payload after the other. `heard` are true payloads, at least one, sealed."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self._ways: tuple[Callable[[bytes, bytes], bytes], ...] = (
            lambda true, _: seal(self._field(true)),
            lambda true, _: seal(self._field(seal(self._field(true)))),
            lambda true, _: seal(flipped(rng, true[:-CRC_BYTES])),
            lambda true, _: flipped(rng, true),
            lambda true, _: seal(true[: rng.randrange(len(true))]),
            lambda true, _: true[: rng.randrange(len(true))],
            lambda true, _: seal(true[:-CRC_BYTES] + rng.randbytes(rng.randrange(1, 40))),
            lambda true, other: seal(true[: len(true) // 2] + other[len(other) // 2 :]),
            lambda _, other: other,  # of another channel
            lambda true, _: true,  # again
            lambda _, __: rng.randbytes(rng.randrange(200)),
            lambda _, __: seal(rng.randbytes(rng.randrange(1, 200))),
            lambda _, __: seal(nested(rng, rng.choice((10, 1_000, 20_000)))),
        )

    def mutate(self, heard: Sequence[bytes], others: Sequence[bytes], max_bytes: int) -> bytes:
        """A payload for the channel of `heard`; `others` are of any channel."""
        rng = self._rng
        if rng.random() < 0.005 and max_bytes <= 1 << 20:
            return seal(bytes(max_bytes + rng.randrange(1, 100)))
        return rng.choice(self._ways)(rng.choice(heard), rng.choice(others))

    def _field(self, true: bytes) -> bytes:
        try:
            tree = msgspec.msgpack.decode(true[:-CRC_BYTES])
            return msgspec.msgpack.encode(replace_one(self._rng, tree))
        except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError):
            return flipped(self._rng, true)[:-CRC_BYTES]
