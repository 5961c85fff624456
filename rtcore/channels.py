"""The channel table: every conversation between processes, one row each.

Transport settings and health both follow from the row; nothing else names a key.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

from rtcore import admission, messages

MessageT = TypeVar("MessageT", bound=messages.Message)

ENV_SERVER, AGENT, LEARNER, RECORDER = "env_server", "agent_service", "learner", "recorder"
PROCESSES = (ENV_SERVER, AGENT, LEARNER, RECORDER)  # in connect order: each connects to the earlier ones
PER_ENV = (ENV_SERVER, AGENT)  # a fleet has these once for each environment
LAUNCHER = "launcher"


def accept(message: messages.Message) -> None:
    """Every message that decodes."""


class Delivery(enum.Enum):
    """What a channel promises, and so how the bus carries it."""

    REALTIME = "realtime"  # newest counts; dropped under congestion, never waited for
    LOSSLESS = "lossless"  # everything counts; cached, recovered, put from a background thread
    RETAINED = "retained"  # the last one is there for whoever joins late
    TELEMETRY = "telemetry"  # nice to have; dropped under congestion


@dataclass(frozen=True, slots=True)
class Channel(Generic[MessageT]):
    """One row of the table.

    Attributes:
        name: how people and counters call it.
        key: key below the run's namespace; `{name}` is an environment or process name, and a reader
            may pass `*` for all.
        type: the message on it.
        delivery: what is promised.
        rate_hz: expected messages per second; None: the control rate; 0: on occasion.
        max_age_s: older than this and the sender counts as late; None: never.
        max_bytes: larger messages are refused and counted, on both sides.
        recorded: whether the recorder subscribes to it.
        writers: the roles that may publish on it; of several, each under its own name alone.
        check: says ValueError to a message that decodes but cannot be meant; it is then rejected.
    """

    name: str
    key: str
    type: type[MessageT]
    delivery: Delivery
    rate_hz: float | None
    max_age_s: float | None
    max_bytes: int
    recorded: bool
    writers: tuple[str, ...]
    check: Callable[[MessageT], None] = accept

    def key_for(self, name: str = "") -> str:
        """The key for one environment or process."""
        return self.key.format(name=name)


_ENV, _ALL = (ENV_SERVER,), (*PROCESSES, LAUNCHER)

SPEC = Channel(
    "spec", "env/{name}/spec", messages.Spec, Delivery.RETAINED, 0, None, 65_536, True, _ENV,
    admission.check_spec,
)  # fmt: skip
STEP = Channel("step", "env/{name}/step", messages.Step, Delivery.REALTIME, None, 2.0, 30_000, False, _ENV)
LOG = Channel(
    "log", "env/{name}/log", messages.StepBatch, Delivery.LOSSLESS, 20, 2.0, 4 << 20, True, _ENV,
    admission.check_batch,
)  # fmt: skip
ACTION = Channel(
    "action", "env/{name}/action", messages.Action, Delivery.REALTIME, None, 2.0, 30_000, False, (AGENT,)
)
POLICY = Channel(
    "policy", "policy", messages.Policy, Delivery.RETAINED, 0, None, 32 << 20, True, (LEARNER,),
    admission.check_policy,
)  # fmt: skip
WINDOW = Channel(
    "window", "window", messages.WindowNotice, Delivery.RETAINED, 0, None, 65_536, True, (LEARNER,),
    admission.check_notice,
)  # fmt: skip
STATS = Channel(
    "stats", "stats/{name}", messages.Stats, Delivery.TELEMETRY, 4, 2.0, 1 << 20, True, _ALL,
    partial(admission.check_stats, speakers=_ALL, numbered=PER_ENV),
)  # fmt: skip

TABLE = (SPEC, STEP, LOG, ACTION, POLICY, WINDOW, STATS)

CONTROL_KEY = "control/{name}"  # query and reply: messages.Command -> messages.CommandReply
ALIVE_KEY = "alive/{name}"  # liveliness token
