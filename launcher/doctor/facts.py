"""What `tenuto doctor` reads from the system. No judgement: that is `doctor_findings`."""

from __future__ import annotations

import os
import platform
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from rtcore import channels, realtime
from rtcore.realtime import Privileges

CPU = Path("/sys/devices/system/cpu")
CLOCKSOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
SCHED = Path("/proc/sys/kernel")
PREEMPT = Path("/sys/kernel/debug/sched/preempt")  # for root alone
PROBE_LIMIT_S = 20.0
SYNCS = 5
BF16_FLAGS = frozenset({"avx512_bf16", "amx_bf16", "bf16"})  # x86, x86, Arm


class Probed(msgspec.Struct, frozen=True):
    """What a process in the env server's place was given."""

    scheduler: str
    memory_locked: bool
    timer_slack_ns: int
    missing: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Facts:
    """What there is. None: this system does not say.

    Attributes:
        probed: what was really obtained, by trying.
        privileges: what limits and capabilities promise.
        bounding: capabilities that any process from here can have, root's too, as a bit mask.
        cores: the cores that may be used.
        siblings: those that share a physical core with the first of them, itself included.
        governors: frequency governors of the usable cores, each once; empty if there are none.
        rt_runtime_us, rt_period_us: what real-time tasks may take of each period; -1: all.
        group_rt_runtime_us: the same for this process's cgroup, where groups have their own.
        autogroup: whether sessions share the processor as equals.
        bf16: whether the processor multiplies bfloat16.
        clock_source: of the kernel.
        preemption: "rt", "full", "lazy", "voluntary", "none", or "dynamic" if it does not say which.
        directory: where runs go, or its nearest parent that exists.
        free_bytes: on its disk.
        sync_ms: median time until a small file is on that disk; None if it cannot be written.
        open_files: the limit for one process.
        user: for the lines of a configuration.
    """

    probed: Probed
    privileges: Privileges
    bounding: int
    cores: tuple[int, ...]
    siblings: tuple[int, ...]
    governors: tuple[str, ...]
    rt_runtime_us: int | None
    rt_period_us: int | None
    group_rt_runtime_us: int | None
    autogroup: bool | None
    bf16: bool
    clock_source: str | None
    preemption: str | None
    directory: Path
    free_bytes: int
    sync_ms: float | None
    open_files: int
    user: str


def gather(runs: Path) -> Facts:
    """Read everything; half a second.

    Args:
        runs: where runs will go; need not exist.
    """
    cores = realtime.allowed_cores()
    directory = next(path for path in (runs.absolute(), *runs.absolute().parents) if path.is_dir())
    autogroup = _number(SCHED / "sched_autogroup_enabled")
    return Facts(
        probed=_probe(),
        privileges=realtime.privileges(),
        bounding=bounding_set(_text(Path("/proc/self/status")) or ""),
        cores=cores,
        siblings=core_list(_text(CPU / f"cpu{cores[0]}/topology/thread_siblings_list") or ""),
        governors=_governors(cores),
        rt_runtime_us=_number(SCHED / "sched_rt_runtime_us"),
        rt_period_us=_number(SCHED / "sched_rt_period_us"),
        group_rt_runtime_us=_group_rt_runtime_us(),
        autogroup=None if autogroup is None else bool(autogroup),
        bf16=has_bf16(_text(Path("/proc/cpuinfo")) or ""),
        clock_source=_text(CLOCKSOURCE),
        preemption=preemption(_text(PREEMPT) or "", platform.version()),
        directory=directory,
        free_bytes=shutil.disk_usage(directory).free,
        sync_ms=_sync_ms(directory),
        open_files=resource.getrlimit(resource.RLIMIT_NOFILE)[0],
        user=_user(),
    )


def core_list(text: str) -> tuple[int, ...]:
    """Core numbers from the kernel's notation: "0-2,5" is 0, 1, 2, 5."""
    found: list[int] = []
    for part in filter(None, text.strip().split(",")):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return tuple(found)


def bounding_set(status: str) -> int:
    """The capability bounding set from the text of /proc/self/status; everything if it is not there."""
    found = (line.split()[1] for line in status.splitlines() if line.startswith("CapBnd:"))
    return int(next(found, "f" * 16), 16)


def has_bf16(cpuinfo: str) -> bool:
    """Whether the flags in the text of /proc/cpuinfo name bfloat16 arithmetic."""
    flags = (
        line.partition(":")[2].split() for line in cpuinfo.splitlines() if line[:5] in ("flags", "Featu")
    )
    return not BF16_FLAGS.isdisjoint(next(flags, []))


def preemption(modes: str, version: str) -> str | None:
    """The kernel's preemption model.

    Args:
        modes: text of /sys/kernel/debug/sched/preempt, like "none voluntary (full)"; empty if unreadable.
        version: as in `uname -v`.
    """
    if "PREEMPT_RT" in version:
        return "rt"
    chosen = modes.partition("(")[2].partition(")")[0]
    if chosen:
        return chosen
    if "PREEMPT_DYNAMIC" in version:
        return "dynamic"
    return "full" if "PREEMPT" in version else "none"


def group_path(cgroups: str) -> str | None:
    """This process's group of the cpu controller (cgroup v1), from the text of /proc/self/cgroup."""
    for line in cgroups.splitlines():
        _, controllers, path = line.split(":", 2)
        if "cpu" in controllers.split(","):
            return path
    return None


def probe() -> bytes:
    """Take the env server's place as far as it is given, and say so as JSON; changes the calling process."""
    placement = realtime.enter(channels.ENV_SERVER, "auto")
    return msgspec.json.encode(
        Probed(placement.scheduler, placement.memory_locked, placement.timer_slack_ns, placement.missing)
    )


def _probe() -> Probed:
    done = subprocess.run(
        [sys.executable, "-m", "launcher.doctor.facts"],
        capture_output=True,
        timeout=PROBE_LIMIT_S,
        check=True,
    )
    return msgspec.json.decode(done.stdout, type=Probed)


def _governors(cores: Sequence[int]) -> tuple[str, ...]:
    found = {_text(CPU / f"cpu{core}/cpufreq/scaling_governor") for core in cores}
    return tuple(sorted(governor for governor in found if governor))


def _group_rt_runtime_us() -> int | None:
    path = group_path(_text(Path("/proc/self/cgroup")) or "")
    if path is None:
        return None
    found = (
        _number(Path(f"/sys/fs/cgroup/{name}{path}/cpu.rt_runtime_us")) for name in ("cpu", "cpu,cpuacct")
    )
    return next((value for value in found if value is not None), None)


def _sync_ms(directory: Path) -> float | None:
    path, times = directory / f".tenuto-doctor-{os.getpid()}", []
    try:
        with path.open("wb") as file:
            for _ in range(SYNCS):
                began = time.monotonic()
                file.write(bytes(4096))
                file.flush()
                os.fsync(file.fileno())
                times.append(1e3 * (time.monotonic() - began))
    except OSError:
        return None
    finally:
        path.unlink(missing_ok=True)
    return statistics.median(times)


def _user() -> str:
    import pwd

    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return str(os.geteuid())


def _text(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None


def _number(path: Path) -> int | None:
    text = _text(path)
    return None if text is None else int(text)


if __name__ == "__main__":
    sys.stdout.buffer.write(probe())
