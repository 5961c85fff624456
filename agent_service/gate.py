"""Which observations get an answer: those of a declared world that can be, each tick once, in order. Pure."""

from __future__ import annotations

import struct
from typing import Literal

import numpy as np

from agent_service.freshness import Freshness
from rtcore.messages import Spec, Step

# What is wrong with an observation, in the words of the counters; "": nothing.
Fault = Literal["", "invalid", "repeated", "superseded"]

# A tick is sent after its deadline. Where a declaration names no host, as in virtual time, roughly so.
SLACK_TICKS = 1_000
# On another host's clock nobody knows which ticks are of the future, so one that was believed and should not
# have been must not silence those that follow: so many in a row, rising, are right.
BELIEVED_IN_A_ROW = 16


class Gate:
    """Judges the observations of one incarnation of the env server."""

    def __init__(self, spec: Spec, boot: str) -> None:
        """`boot`: whose clock this process's stamps are of (`rtcore.epoch.this_boot`)."""
        self._spec = spec
        self._one_clock = spec.host in ("", boot)
        self._slack = 0 if spec.host else SLACK_TICKS
        self._freshness = Freshness(spec.tick_ns)
        self._newest = -1  # tick that was answered last
        # The tick that was too old last, and how many of them rose in a row.
        self._refused, self._in_a_row = -1, 0

    def judge(self, step: Step, received_ns: int) -> Fault:
        """What is wrong with `step`: `invalid`, it cannot be of this world, or of now; `repeated`, it, or a
        later one, was answered; `superseded`, newer ones are behind it."""
        if not self._possible(step, received_ns) or not _fits(step.observation, self._spec):
            return "invalid"
        # A rehearsal is the newest step once more.
        old = step.tick < self._newest or (step.tick == self._newest and not step.rehearsal)
        if old and (self._one_clock or not self._recovered(step.tick)):
            return "repeated"
        self._in_a_row = 0
        if step.rehearsal:
            return ""
        if self._freshness.is_old(step.sent_ns, received_ns):
            return "superseded"
        self._newest = step.tick
        return ""

    def _possible(self, step: Step, received_ns: int) -> bool:
        """Whether the tick can be over and its step sent by now."""
        if not self._one_clock:
            return True
        over = max(0, received_ns - self._spec.t0_ns) // self._spec.tick_ns
        return step.sent_ns <= received_ns and step.tick <= over + self._slack

    def _recovered(self, tick: int) -> bool:
        """Whether it was the newest one that was wrong; then nothing of it stays."""
        self._in_a_row = self._in_a_row + 1 if tick > self._refused else 0
        self._refused = tick
        if self._in_a_row < BELIEVED_IN_A_ROW:
            return False
        self._newest, self._freshness = -1, Freshness(self._spec.tick_ns)
        return True


def _fits(observation: bytes, spec: Spec) -> bool:
    """Whether it is one of this world's: as long as declared, of finite numbers, and in a finite world a
    state's number."""
    if len(observation) != 4 * spec.observation_dim:
        return False
    if not spec.states:
        return bool(np.isfinite(np.frombuffer(observation, "<f4")).all())
    state: float = struct.unpack_from("<f", observation)[0]
    return 0 <= state < spec.states and state.is_integer()
