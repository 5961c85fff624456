"""What a message must be, beyond decoding, before a service may see it. Pure; each says ValueError if not.

A check rejects what no process of ours ever says: a damaged sender's, another version's, a stranger's. It
knows one message alone. Whether that fits to what came before it is judged by who reads it: `LogReader` for
steps, the agent for observations and policies, the env server for actions.

`Step` and `Action` have no check: both are on the real-time path, where one takes longer than decoding may
(0.2 us of 1.6), and who reads them compares sizes and values anyway. Integers are bounded by their types.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence

from rtcore.histogram import Histogram
from rtcore.messages import MOST, Architecture, Command, Policy, Spec, Stats, Step, StepBatch, WindowNotice

MAX_DIM = 65_536  # of an observation, an action or a layer: a table of two such sides is 16 GiB of float32
MAX_LAYERS = 64
MAX_NAME = 256  # characters of a name
MAX_NAMES = 512  # counters, and likewise gauges and histograms, of one process
MAX_EVENTS = 512  # in one message; a ledger has 256
MAX_EVENT_TEXT = 1_000  # characters; a ledger cuts at 500
MAX_TICK = 1 << 40  # 35 years at 1 kHz
MAX_BOUND = 1e30  # of an action: its square is not far from what float32 can hold
MAX_BATCH_STEPS = 10_000
# What makes the environments of a fleet the same task: what was learned in one holds in the others.
_TASK = (
    "tick_ns", "unit_ns", "observation_dim", "action_dim", "states", "actions", "action_low", "action_high",
    "action_delay_ticks",
)  # fmt: skip


def check_spec(spec: Spec) -> None:
    """A world that can be: sizes that fit into memory, and a finite range for each entry of an action."""
    _names((spec.env, spec.env_id, spec.scene, spec.host))
    _within("t0_ns", spec.t0_ns, -MOST, MOST)
    for name in ("observation_dim", "action_dim", "states", "actions", "action_delay_ticks"):
        _within(name, getattr(spec, name), 0, MAX_DIM)
    if (spec.states > 0) != (spec.actions > 0):
        raise ValueError(f"states = {spec.states}, actions = {spec.actions}: both or neither are numbered")
    for name, bounds in (("action_low", spec.action_low), ("action_high", spec.action_high)):
        if len(bounds) != spec.action_dim:
            raise ValueError(f"{name}: {len(bounds)} numbers, action_dim = {spec.action_dim}")
        if not all(abs(bound) <= MAX_BOUND for bound in bounds):
            raise ValueError(f"{name}: must be within +-{MAX_BOUND:g}")
    pairs = zip(spec.action_low, spec.action_high, strict=True)
    if not all(low < high or (low == high and spec.actions == 1) for low, high in pairs):
        raise ValueError("action_low: must be below action_high")


def check_same_world(spec: Spec, first: Spec) -> None:
    """A later incarnation of the world that declared itself as `first`."""
    _compare(spec, first, ("env", *_TASK))


def check_same_task(spec: Spec, first: Spec) -> None:
    """The world that declared itself as `first`, or another of its fleet."""
    _compare(spec, first, _TASK)


def is_same_world(spec: Spec, first: Spec) -> bool:
    """Whether `check_same_world` has nothing against it."""
    try:
        check_same_world(spec, first)
    except ValueError:
        return False
    return True


def check_batch(batch: StepBatch) -> None:
    """Steps of one incarnation in their order, made of finite numbers."""
    steps = batch.steps
    if not steps:
        return
    if len(steps) > MAX_BATCH_STEPS:
        raise ValueError(f"{len(steps)} steps: at most {MAX_BATCH_STEPS} in a batch")
    first, before = steps[0], steps[0]
    for step in steps:
        if step.incarnation != first.incarnation or step.env != first.env:
            raise ValueError("steps of several incarnations in one batch")
        if step.seq < before.seq or step.tick < before.tick:
            raise ValueError(f"seq {step.seq}, tick {step.tick} after {before.seq}, {before.tick}")
        before = step
    if before.tick > MAX_TICK or before.seq > before.tick:
        raise ValueError(f"seq {before.seq} at tick {before.tick}: at most the tick, and that {MAX_TICK}")
    _finite(steps)


def check_policy(policy: Policy) -> None:
    """An architecture that can be built; the weights are judged by who acts on them."""
    _within("version", policy.version, 1, MAX_TICK)
    _names((policy.algo, policy.sha256))
    _architecture(policy.architecture)
    if len(policy.signature) > MAX_NAME:
        raise ValueError(f"signature: {len(policy.signature)} bytes, at most {MAX_NAME}")


def check_notice(notice: WindowNotice) -> None:
    """A phase of a window within a run of some length."""
    _within("at_ns", notice.at_ns, -MOST, MOST)
    _within("window", notice.window, 0, MAX_TICK)
    _within("start_unit", notice.start_unit, 0, MAX_TICK)
    _within("update_units", notice.update_units, 0, MAX_TICK)
    _within("hold_units", notice.hold_units or 0, 0, MAX_TICK)


def check_stats(stats: Stats, speakers: Collection[str], numbered: Collection[str]) -> None:
    """A ledger of one of the `speakers`, of which a fleet has the `numbered` up to 16 times; of a size that a
    reader can keep, whose histograms decode.
    """
    role, dot, index = stats.process.partition(".")  # of a fleet's process; see `rtcore.cast`
    one_of_several = role in numbered and re.fullmatch(r"[0-9]|1[0-5]", index)
    if role not in speakers or (dot and not one_of_several):
        raise ValueError(f"process = {_short(stats.process)}: is none of ours")
    for table in (stats.counters, stats.gauges, stats.histograms):
        if len(table) > MAX_NAMES:
            raise ValueError(f"{len(table)} names: at most {MAX_NAMES}")
        _names(table)
    for name, count in stats.counters.items():
        _within(name, count, 0, MOST)
    if len(stats.events) > MAX_EVENTS:
        raise ValueError(f"{len(stats.events)} events: at most {MAX_EVENTS}")
    if any(len(event.text) > MAX_EVENT_TEXT for event in stats.events):
        raise ValueError(f"an event of more than {MAX_EVENT_TEXT} characters")
    for notice in stats.windows:
        check_notice(notice)
    for data in stats.histograms.values():
        Histogram.from_bytes(data)


def check_command(command: Command) -> None:
    """An order whose parts go together."""
    _names((command.id,))
    if command.schedule is not None and command.verb != "schedule":
        raise ValueError(f"verb = {command.verb}: it takes no schedule")


def _compare(spec: Spec, first: Spec, names: Sequence[str]) -> None:
    for name in names:
        if getattr(spec, name) != getattr(first, name):
            raise ValueError(
                f"{name} = {_short(getattr(spec, name))}: the world has {_short(getattr(first, name))}"
            )


def _finite(steps: Sequence[Step]) -> None:
    """All numbers that learning goes by, at once: one by one they would take ten times as long."""
    scalars = [number for step in steps for number in (step.reward, step.drift, *step.physics)]
    singles = b"".join([part for step in steps for part in (step.observation, step.action, step.decision)])
    if len(singles) % 4:
        raise ValueError("an array that is no whole number of numbers")
    # NaN and Inf survive a sum, and numbers that a sum makes infinite are none that a world gives.
    if not math.isfinite(sum(scalars)) or not math.isfinite(sum(memoryview(singles).cast("f"))):
        raise ValueError("a number that is not finite")


def _architecture(architecture: Architecture) -> None:
    for name in ("observation_dim", "action_dim", "states", "actions"):
        _within(name, getattr(architecture, name), 0, MAX_DIM)
    if len(architecture.hidden) > MAX_LAYERS:
        raise ValueError(f"hidden: {len(architecture.hidden)} layers, at most {MAX_LAYERS}")
    for units in architecture.hidden:
        _within("hidden", units, 1, MAX_DIM)


def _within(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise ValueError(f"{_short(name)} = {value}: must be within [{least}, {most}]")


def _names(names: Collection[str]) -> None:
    for name in names:
        if len(name) > MAX_NAME:
            raise ValueError(f"a name of {len(name)} characters: at most {MAX_NAME}")


def _short(value: object) -> str:
    """A stranger's words, on one line and not too many of them."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."
