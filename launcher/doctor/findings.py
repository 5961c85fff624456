"""What the facts mean for real time: what there is, what more would gain, and how to grant it. Pure.

Gains that are figures were measured on two cores of a virtual machine, beside a learner.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from launcher.doctor.facts import Facts
from rtcore.realtime import (
    CAP_IPC_LOCK,
    CAP_SYS_NICE,
    FIFO,
    FIFO_PRIORITY,
    GRANTS,
    MEMORY,
    NICENESS,
    PINNING,
    SLACK,
)

# good: nothing to gain; lacking: `agent.rt = "require"` refuses to start; better: it could be better.
State = Literal["good", "lacking", "better"]

STEAL_WORTH_A_WORD = 0.002  # of all processor time; 1.4 % of a core went with misses of 0.55 % at 500 Hz
FREE_WORTH_A_WORD = 2 << 30  # a full replay of HalfCheetah's transitions takes 0.2 GB; a recording grows
SYNC_WORTH_A_WORD_MS = 50.0
OPEN_FILES_NEEDED = 256  # a process of ours opens some 60: sockets, logs, the replay
CAP_SYS_RESOURCE = 24
_CAPS = "+sys_nice,+ipc_lock"
HAND_DOWN = (
    "sudo setpriv --reuid=$(id -u) --regid=$(id -g) --init-groups"
    f" --inh-caps={_CAPS} --ambient-caps={_CAPS} $SHELL"
)
CONTAINER = "docker run --cap-add SYS_NICE --ulimit rtprio=50 --ulimit memlock=-1 ...   # outside"
STEADY_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock")  # read without a system call


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the diagnosis.

    Attributes:
        topic: what it is about.
        state: how it stands.
        found: what there is.
        gain: what more would bring; empty if nothing.
        grant: the commands that give it; empty where none can.
    """

    topic: str
    state: State
    found: str
    gain: str = ""
    grant: tuple[str, ...] = ()


def findings(facts: Facts, stolen: float | None) -> list[Finding]:
    """The diagnosis, what matters most first.

    Args:
        facts: what there is.
        stolen: the share of all processor time that the host took while this was watched; None if untold.
    """
    checks: tuple[Callable[[Facts], Finding | None], ...] = (
        _fifo, _memory, _cores, _pinning, _slack, _throttling, _preemption, _governor, _clock, _autogroup,
        _bf16, _disk, _open_files,
    )  # fmt: skip
    found = [finding for check in checks if (finding := check(facts)) is not None]
    found.insert(3, _steal(stolen))
    return found


def verdict(facts: Facts) -> str:
    """Whether `agent.rt = "require"` would start, in one line."""
    missing = facts.probed.missing
    if not missing:
        return 'agent.rt = "require" is granted here'
    return f'agent.rt = "require" is refused here for want of {", ".join(missing)}; "auto" does without'


def _fifo(facts: Facts) -> Finding:
    found = f"{facts.probed.scheduler} for env server and agent"
    if FIFO not in facts.probed.missing:
        return Finding(FIFO, "good", found)
    gain = "1 kHz ticks, wake-up error p99/p99.9: 569/3333 µs without, 0.6/82 µs with"
    if facts.privileges.max_priority >= 1:  # promised, and yet refused: the group has no share
        reason, grant = _why_refused(facts)
        return Finding(FIFO, "lacking", f"{found}; allowed by the limits, but {reason}", gain, grant)
    grant = _ways(facts, GRANTS[FIFO], "rtprio", str(FIFO_PRIORITY))
    return Finding(FIFO, "lacking", f"{found}; the rtprio limit is 0", gain, grant)


def _why_refused(facts: Facts) -> tuple[str, tuple[str, ...]]:
    if facts.rt_runtime_us == 0:
        return "kernel.sched_rt_runtime_us is 0", ("sudo sysctl kernel.sched_rt_runtime_us=950000",)
    if facts.group_rt_runtime_us == 0:
        grant = "echo 900000 | sudo tee /sys/fs/cgroup/cpu/<this group>/cpu.rt_runtime_us"
        return "its control group has no real-time share (cpu.rt_runtime_us = 0)", (grant,)
    return "the system refuses it (a sandbox?)", (CONTAINER,)


def _memory(facts: Facts) -> Finding:
    if MEMORY not in facts.probed.missing:
        return Finding(MEMORY, "good", "pages of env server and agent stay in memory")
    return Finding(
        MEMORY,
        "lacking",
        "the memlock limit is finite",
        "no page fault in a tick when memory is short; no gain could be measured where it is not",
        _ways(facts, GRANTS[MEMORY], "memlock", "unlimited"),
    )


def _cores(facts: Facts) -> Finding:
    count = len(facts.cores)
    if count < 2:
        gain = "a second core: the learner and the recorder would keep off the one that acts"
        return Finding("cores", "better", "1: all processes share it", gain)
    shared = [core for core in facts.siblings if core != facts.cores[0] and core in facts.cores]
    if shared and len(shared) == count - 1:
        return Finding(
            "cores",
            "better",
            f"{count}, threads of one physical core",
            "a physical core: the learner's arithmetic slows what acts beside it (not measured here)",
        )
    return Finding("cores", "good", f"{count}: core {facts.cores[0]} acts, the others learn and record")


def _pinning(facts: Facts) -> Finding | None:
    if PINNING not in facts.probed.missing:
        return None
    gain = "500 Hz, misses without SCHED_FIFO: 1.2 % free to move, 0.04 % pinned"
    return Finding(PINNING, "lacking", "refused", gain, (GRANTS[PINNING],))


def _slack(facts: Facts) -> Finding:
    missing = [what for what in (SLACK, NICENESS) if what in facts.probed.missing]
    if not missing:
        return Finding(SLACK, "good", f"{facts.probed.timer_slack_ns} ns")
    gain = "wake-up error p50 83 µs with the default of 50 µs, 43 µs without"
    return Finding(missing[0], "lacking", "refused", gain, tuple(GRANTS[what] for what in missing))


def _steal(stolen: float | None) -> Finding:
    if stolen is None:
        return Finding("steal time", "good", "the system does not tell; none on hardware of one's own")
    found = f"{100 * stolen:.2f} % of processor time"
    if stolen < STEAL_WORTH_A_WORD:
        return Finding("steal time", "good", found)
    gain = "the host's time cannot be had by any setting: gaps of 10 to 16 ms were seen at 1.4 % of a core"
    return Finding("steal time", "better", found, gain, ("a machine, or virtual cores, of one's own",))


def _throttling(facts: Facts) -> Finding | None:
    runtime, period = facts.rt_runtime_us, facts.rt_period_us
    if runtime is None or not period or runtime == 0:  # 0 is told with SCHED_FIFO
        return None
    if runtime < 0:
        found = "off: a real-time task that does not sleep would take its core for good"
        grant = ("sudo sysctl kernel.sched_rt_runtime_us=950000",)
        return Finding("RT throttling", "better", found, "a guard; ours sleep in every tick", grant)
    share = f"{100 * runtime / period:g} %"
    return Finding("RT throttling", "good", f"real-time tasks get {share} of a core: enough, ours sleep")


def _preemption(facts: Facts) -> Finding | None:
    model = facts.preemption
    if model is None:
        return None
    if model in ("rt", "full"):
        return Finding("kernel", "good", f"preemption {model}")
    gain = "shorter waits for the kernel itself; not measured here"
    boot = "boot with preempt=full, or a PREEMPT_RT kernel"
    if model == "dynamic":
        return Finding(
            "kernel", "better", "preemption can be chosen at boot; which was is not told", gain, (boot,)
        )
    grant = ("echo full | sudo tee /sys/kernel/debug/sched/preempt", boot)
    return Finding("kernel", "better", f"preemption {model}", gain, grant)


def _governor(facts: Facts) -> Finding:
    if not facts.governors:
        return Finding("frequency", "good", "not scaled by this system")
    found = ", ".join(facts.governors)
    if facts.governors == ("performance",):
        return Finding("frequency", "good", found)
    grant = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
    gain = "no slow first microseconds after a sleep (not measured here)"
    return Finding("frequency", "better", f"governor {found}", gain, (grant,))


def _clock(facts: Facts) -> Finding | None:
    if facts.clock_source is None:
        return None
    if facts.clock_source in STEADY_CLOCKS:
        return Finding("clock", "good", facts.clock_source)
    gain = "reading the time costs a system call and microseconds with this one"
    return Finding("clock", "better", facts.clock_source, gain, ("boot with clocksource=tsc",))


def _autogroup(facts: Facts) -> Finding | None:
    if not facts.autogroup:
        return None
    return Finding(
        "autogroup",
        "good",
        "on: niceness ranks within one session, so start all processes from one launcher or shell",
    )


def _bf16(facts: Facts) -> Finding:
    if facts.bf16:
        return Finding("bfloat16", "good", "in the processor: learner.precision can use it")
    gain = "twice the peak of float32 products, where there is one (188 against 94 GFLOP/s)"
    return Finding("bfloat16", "better", "not in this processor", gain)


def _disk(facts: Facts) -> Finding:
    found = f"{facts.free_bytes / 2**30:,.1f} GiB free in {facts.directory}"
    if facts.sync_ms is None:
        return Finding(
            "disk",
            "better",
            f"{found}, which cannot be written",
            "runs need a place",
            ("tenuto run --run-dir DIR",),
        )
    found += f", {facts.sync_ms:.1f} ms to put a page there"
    if facts.free_bytes < FREE_WORTH_A_WORD or facts.sync_ms > SYNC_WORTH_A_WORD_MS:
        return Finding("disk", "better", found, "room and speed for recording, replay and checkpoints")
    return Finding("disk", "good", found)


def _open_files(facts: Facts) -> Finding:
    if facts.open_files >= OPEN_FILES_NEEDED:
        return Finding("open files", "good", f"{facts.open_files:,} for a process")
    gain = f"a process needs up to {OPEN_FILES_NEEDED}"
    return Finding(
        "open files", "better", str(facts.open_files), gain, (f"ulimit -n {4 * OPEN_FILES_NEEDED}",)
    )


def _ways(facts: Facts, command: str, item: str, value: str) -> tuple[str, ...]:
    """How to grant what a limit withholds: for this shell and, where PAM sets limits, for good.

    Raising a limit takes CAP_SYS_RESOURCE, which root has not in many containers; there the capabilities
    themselves can be handed down, or the container has to be started with more.
    """
    if facts.bounding >> CAP_SYS_RESOURCE & 1:
        line = f"{facts.user} - {item} {value}"
        lasting = f"echo '{line}' | sudo tee -a /etc/security/limits.d/tenuto.conf   # from the next login on"
        return (command, lasting)
    if all(facts.bounding >> capability & 1 for capability in (CAP_SYS_NICE, CAP_IPC_LOCK)):
        return (HAND_DOWN,)
    return (CONTAINER,)
