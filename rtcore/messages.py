"""Everything that two processes say to each other: one frozen struct per channel.

Encoded as msgpack arrays, so field order is the wire format: new fields go last and have defaults.
Constraints are checked on decode. Arrays travel as little-endian bytes; their shape and dtype are
given once, in `Spec`. All `*_ns` stamps are integer nanoseconds of the host's monotonic clock.
"""

from __future__ import annotations

from typing import Annotated, Literal, get_args

import msgspec

from rtcore.config import ScheduleConfig

MOST = 1 << 62  # of any number on the wire: sums and differences of two stay within 64 bits
Count = Annotated[int, msgspec.Meta(ge=0, le=MOST)]
Nanos = Annotated[int, msgspec.Meta(ge=0, le=MOST)]  # 146 years
Index = Annotated[int, msgspec.Meta(ge=-1, le=MOST)]  # -1 means "none"

MissCause = Literal[
    "",
    "agent_absent",
    "agent_stalled",
    "agent_late",
    "policy_swap",
    "collector_pause",
    "transport",
    "env_late",
]
CAUSES: tuple[MissCause, ...] = get_args(MissCause)[1:]  # without "", which is none
Fallback = Literal["", "hold", "neutral"]
Phase = Literal["update", "hold"]
Level = Literal["DEBUG", "INFO", "WARN", "ERROR"]


class Message(msgspec.Struct, frozen=True, kw_only=True, array_like=True, forbid_unknown_fields=False):
    """Base of all messages."""


class Spec(Message, frozen=True, kw_only=True):
    """What an env server declares once per incarnation, before its first tick.

    Observations and actions are float32 vectors; actions are in the environment's own units,
    within [action_low, action_high].
    """

    env: str
    env_id: str
    incarnation: Nanos  # of the env server: greater after every restart
    t0_ns: int  # deadline of tick 0; below 0 if the host was started anew since
    wall_t0_ns: Nanos  # Unix time at t0_ns, for the `wall` timeline alone
    tick_ns: Annotated[int, msgspec.Meta(gt=0, le=MOST)]
    unit_ns: Annotated[int, msgspec.Meta(gt=0, le=MOST)]
    observation_dim: Annotated[int, msgspec.Meta(gt=0)]  # with what `notify` tells and observed actions
    action_dim: Annotated[int, msgspec.Meta(gt=0)]
    action_low: list[float]
    action_high: list[float]
    action_delay_ticks: Count = 0
    native_period_ns: Count = 0  # simulated time per tick; 0: a world without a simulator
    scene: str = ""  # how to draw the world: "mujoco" (with `world.mjb` in the run), "point", "grid" or ""
    # A finite world has numbered states and actions: an observation is the state's number, an action its own.
    states: Count = 0  # 0: observations are continuous
    actions: Count = 0  # 0: actions are continuous
    host: str = ""  # the boot whose monotonic clock the stamps are of (`rtcore.epoch.this_boot`)


class Step(Message, frozen=True, kw_only=True):
    """The world right after tick k, and how that tick came about.

    The tick ran over (D_{k-1}, D_k] under `action`. A reset tick has episode_tick 0, no action, and
    reward 0. `seq` counts executed ticks without gaps; `tick` skips the deadlines that an overrun lost.
    """

    env: str
    incarnation: Nanos
    seq: Count
    tick: Count
    episode: Count
    episode_tick: Count
    unit: Count  # t, the paper's unit of time
    due_ns: Nanos  # D_k
    woke_ns: Nanos  # when the env server really began the tick
    sent_ns: Nanos  # when this step was handed to the transport
    observation: bytes  # float32 [observation_dim]
    reward: float  # earned over the tick
    terminated: bool  # the task ended: bootstrap with 0
    truncated: bool  # only the time limit ended: bootstrap with V(s)
    action: bytes  # float32 [action_dim], really applied over the tick; empty at a reset
    decision: bytes  # the action that entered the delay line at D_k; same as `action` without delay
    answered_tick: Index  # tick of the observation that `decision` answered
    policy_version: Index  # policy behind `decision`; 0 is the uniformly random pi_0
    missed: bool  # no answer to observation k-1 at D_k
    fallback: Fallback  # what acted instead
    cause: MissCause  # of the miss; known a little later, so on the log only
    skipped: Count  # deadlines lost right before this tick
    loop_ns: Index  # previous step sent -> its answer received here; -1 if none came in time
    reaction_ns: Index  # the agent's own share of it: observation received -> action sent
    drift: float  # the true value; for the recorder and regret, never read by agent or learner
    position: bytes  # float64 simulator qpos (or position), for drawing
    rehearsal: bool = False  # sent once more to keep the act path warm: on the real-time path only
    late_loop_ns: Index = -1  # of the newest answer heard at this tick that came too late; -1: there was none
    late_reaction_ns: Index = -1
    physics: list[float] = []  # true factors on mass, friction, gravity, if any drifts; as `drift`, not read


class StepBatch(Message, frozen=True, kw_only=True):
    """Consecutive steps of one incarnation, on the lossless path."""

    steps: list[Step]
    last: bool = False  # the env server ended in order: nothing follows


class Action(Message, frozen=True, kw_only=True):
    """The agent's answer to one observation."""

    env: str
    incarnation: Nanos  # of the env server that it answers
    tick: Count  # of the observation that it answers
    values: bytes  # float32 [action_dim], environment units
    policy_version: Count  # 0 is the uniformly random pi_0
    received_ns: Nanos
    sent_ns: Nanos
    # What may explain a missed deadline, between the previous answer and this one:
    swap_ns: Nanos = 0  # a policy was checked or swapped in
    collector_ns: Nanos = 0  # the garbage collector ran
    starved_ns: Nanos = 0  # the acting thread could have run but had no core
    # And when the agent's process was last continued after a stop, and since when it answers at all:
    resumed_ns: Nanos = 0  # 0: never
    since_ns: Nanos = 0
    rehearsal: bool = False  # answers a rehearsal: it never acts


class Architecture(Message, frozen=True, kw_only=True):
    """What is behind a policy.

    tanh_gaussian_mlp: a ReLU MLP with two heads, mean and log standard deviation. An action in [-1, 1]
    is tanh(mean + std * noise); the agent scales it to the action space.
    categorical_table: a probability for each action in each state of a finite world.
    """

    kind: Literal["tanh_gaussian_mlp", "categorical_table"]
    observation_dim: Annotated[int, msgspec.Meta(gt=0)]
    action_dim: Annotated[int, msgspec.Meta(gt=0)]
    hidden: list[int]
    states: Count = 0  # of a table
    actions: Count = 0


class Policy(Message, frozen=True, kw_only=True):
    """One published iterate pi^g of window m."""

    version: Annotated[int, msgspec.Meta(gt=0, le=MOST)]  # rises by one, across restarts
    window: Count
    iterate: Count
    algo: str
    architecture: Architecture
    weights: bytes  # safetensors, float32
    sha256: str  # hex digest of `weights`
    created_ns: Nanos
    signature: bytes = b""  # of all the others, by the learner's key; empty: not signed


class WindowNotice(Message, frozen=True, kw_only=True):
    """The learner entered a phase of window m = [start, start + update + hold) units."""

    window: Count
    start_unit: Count
    update_units: Count
    hold_units: Count | None  # None: held for good
    phase: Phase
    at_ns: int  # stamp of the phase's start; see `Spec.t0_ns`
    reason: Literal["schedule", "operator"] = "schedule"


class Event(Message, frozen=True, kw_only=True):
    """A line for people, on the timeline and in the process's log."""

    at_ns: Nanos
    level: Level
    text: str


class EpisodeReturn(Message, frozen=True, kw_only=True):
    """Return of one finished episode."""

    episode: Count
    at_ns: Nanos
    value: float
    length: Count


class Stats(Message, frozen=True, kw_only=True):
    """A process's ledger, whole: counters and histograms are cumulative since its start.

    Whoever reads it keeps the newest per (process, incarnation) and adds over incarnations.
    """

    process: str
    incarnation: Nanos
    seq: Count
    at_ns: Nanos
    final: bool  # the process ended in order; nothing follows
    counters: dict[str, int]
    gauges: dict[str, float]
    histograms: dict[str, bytes]  # see rtcore.histogram
    events: list[Event] = []  # of the last 10 s and since the previous message; so they repeat
    returns: list[EpisodeReturn] = []  # the newest ones; repeated, so that a lost message loses none
    windows: list[WindowNotice] = []  # the learner's phases so far
    beat_ns: Nanos = 0  # when the process's own loop last turned; 0: not yet


class Command(Message, frozen=True, kw_only=True):
    """An operator's order to one process. Repeating an `id` repeats the reply, not the deed."""

    id: str
    verb: Literal["hold", "resume", "status", "stop", "schedule"]
    schedule: ScheduleConfig | None = None  # to go by, of the verb of that name


class CommandReply(Message, frozen=True, kw_only=True):
    """The answer to a command."""

    id: str
    ok: bool
    text: str
