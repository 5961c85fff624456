"""`tenuto doctor`: its judgement of made-up facts, its reading of made-up texts, and the real command."""

from __future__ import annotations

import os
import subprocess
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from launcher.doctor.command import stolen
from launcher.doctor.facts import (
    Facts,
    Probed,
    bounding_set,
    core_list,
    gather,
    group_path,
    has_bf16,
    preemption,
)
from launcher.doctor.findings import CONTAINER, HAND_DOWN, Finding, findings, verdict
from launcher.echo.measure import EchoResult
from rtcore.realtime import CAP_IPC_LOCK, CAP_SYS_NICE, FIFO, GRANTS, MEMORY, PINNING, SLACK, Privileges
from tests.launcher.commands import command_line, tenuto
from tests.launcher.latency_results import ECHO

GOOD = Facts(
    probed=Probed("SCHED_FIFO 50", memory_locked=True, timer_slack_ns=1, missing=()),
    privileges=Privileges(max_priority=99, lock_memory=True),
    bounding=0xFFFF_FFFF_FFFF,
    cores=(0, 1, 2, 3),
    siblings=(0,),
    governors=("performance",),
    rt_runtime_us=950_000,
    rt_period_us=1_000_000,
    group_rt_runtime_us=None,
    autogroup=True,
    bf16=True,
    clock_source="tsc",
    preemption="full",
    directory=Path("/runs"),
    free_bytes=100 << 30,
    sync_ms=0.2,
    open_files=1024,
    user="ada",
)
REFUSED = replace(
    GOOD,
    probed=Probed("SCHED_OTHER", memory_locked=False, timer_slack_ns=1, missing=(FIFO, MEMORY)),
    privileges=Privileges(max_priority=0, lock_memory=False),
)


def found(facts: Facts, topic: str, stolen_share: float | None = 0.0) -> Finding:
    (finding,) = [one for one in findings(facts, stolen_share) if one.topic == topic]
    return finding


def test_where_nothing_lacks_nothing_is_advised() -> None:
    everything = findings(GOOD, 0.0)
    assert {finding.state for finding in everything} == {"good"}
    assert not any(finding.grant or finding.gain for finding in everything)
    assert [finding.topic for finding in everything] == [
        "SCHED_FIFO", "locked memory", "cores", "steal time", "timer slack", "RT throttling", "kernel",
        "frequency", "clock", "autogroup", "bfloat16", "disk", "open files",
    ]  # fmt: skip
    assert verdict(GOOD) == 'agent.rt = "require" is granted here'


def test_limits_are_raised_for_the_shell_and_for_good() -> None:
    fifo, memory = found(REFUSED, FIFO), found(REFUSED, MEMORY)
    assert fifo.state == memory.state == "lacking"
    assert fifo.grant[0] == GRANTS[FIFO] and memory.grant[0] == GRANTS[MEMORY]
    assert fifo.grant[1].startswith("echo 'ada - rtprio 50' | sudo tee -a /etc/security/limits.d/tenuto.conf")
    assert memory.grant[1].startswith("echo 'ada - memlock unlimited' | ")
    assert "3333" in fifo.gain and "82" in fifo.gain
    assert verdict(REFUSED) == (
        'agent.rt = "require" is refused here for want of SCHED_FIFO, locked memory; "auto" does without'
    )


def test_where_root_may_not_raise_limits_capabilities_are_handed_down() -> None:
    without_resource = 0xFFFF_FFFF_FFFF & ~(1 << 24)
    assert found(replace(REFUSED, bounding=without_resource), FIFO).grant == (HAND_DOWN,)
    no_nice = without_resource & ~(1 << CAP_SYS_NICE)
    assert found(replace(REFUSED, bounding=no_nice), FIFO).grant == (CONTAINER,)
    no_lock = without_resource & ~(1 << CAP_IPC_LOCK)
    assert found(replace(REFUSED, bounding=no_lock), MEMORY).grant == (CONTAINER,)


def test_promised_and_yet_refused() -> None:
    promised = replace(REFUSED, privileges=Privileges(max_priority=50, lock_memory=True))
    throttled = found(replace(promised, rt_runtime_us=0), FIFO)
    assert throttled.grant == ("sudo sysctl kernel.sched_rt_runtime_us=950000",)
    assert "RT throttling" not in [one.topic for one in findings(replace(promised, rt_runtime_us=0), None)]
    assert "cpu.rt_runtime_us = 0" in found(replace(promised, group_rt_runtime_us=0), FIFO).found
    assert found(promised, FIFO).grant == (CONTAINER,)


@pytest.mark.parametrize(
    ("change", "topic", "words"),
    [
        ({"cores": (3,), "siblings": (3,)}, "cores", "1: all processes share it"),
        ({"cores": (0, 1), "siblings": (0, 1)}, "cores", "threads of one physical core"),
        ({"governors": ("powersave", "schedutil")}, "frequency", "powersave, schedutil"),
        ({"clock_source": "hpet"}, "clock", "hpet"),
        ({"preemption": "voluntary"}, "kernel", "preemption voluntary"),
        ({"preemption": "dynamic"}, "kernel", "chosen at boot"),
        ({"rt_runtime_us": -1}, "RT throttling", "off"),
        ({"bf16": False}, "bfloat16", "not in this processor"),
        ({"free_bytes": 1 << 30}, "disk", "1.0 GiB free"),
        ({"sync_ms": 80.0}, "disk", "80.0 ms"),
        ({"sync_ms": None}, "disk", "cannot be written"),
        ({"open_files": 64}, "open files", "64"),
    ],
)
def test_what_could_be_better(change: dict[str, object], topic: str, words: str) -> None:
    finding = found(replace(GOOD, **change), topic)  # type: ignore[arg-type]
    assert finding.state == "better" and finding.gain
    assert words in finding.found
    assert [one.topic for one in findings(replace(GOOD, **change), 0.0) if one.state != "good"] == [topic]  # type: ignore[arg-type]


def test_four_cores_of_which_two_are_siblings_suffice() -> None:
    assert found(replace(GOOD, siblings=(0, 1)), "cores").state == "good"


def test_refused_calls_are_told() -> None:
    probed = Probed("SCHED_FIFO 50", memory_locked=True, timer_slack_ns=50_000, missing=(PINNING, SLACK))
    refused = replace(GOOD, probed=probed)
    assert found(refused, PINNING).state == found(refused, SLACK).state == "lacking"
    assert found(refused, SLACK).grant == (GRANTS[SLACK],)


def test_steal_time() -> None:
    assert found(GOOD, "steal time", 0.001).state == "good"
    assert found(GOOD, "steal time", 0.007).state == "better"
    assert found(GOOD, "steal time", 0.007).found == "0.70 % of processor time"
    assert "does not tell" in found(GOOD, "steal time", None).found


def test_the_share_that_the_host_took() -> None:
    def echo(steal_s: float | None, span_s: float) -> EchoResult:
        return replace(ECHO, steal_s=steal_s, span_s=span_s)

    assert stolen({"off": echo(0.1, 2.0), "auto": echo(0.3, 3.0)}, 4) == pytest.approx(0.4 / 20)
    assert stolen({"off": echo(None, 2.0), "auto": echo(0.3, 3.0)}, 1) == pytest.approx(0.1)
    assert stolen({"off": echo(None, 2.0)}, 1) is None
    assert stolen({}, 1) is None


def test_readings() -> None:
    assert core_list("0-2,5\n") == (0, 1, 2, 5)
    assert core_list("7") == (7,) and core_list("") == ()
    assert has_bf16("processor: 0\nflags\t\t: fpu avx512f avx512_bf16 sse\n")
    assert has_bf16("Features\t: fp asimd bf16\n")
    assert not has_bf16("flags : fpu avx512f\nbugs : amx_bf16\n")
    assert preemption("none voluntary (full) lazy", "#1 SMP PREEMPT_DYNAMIC") == "full"
    assert preemption("", "#1 SMP PREEMPT_DYNAMIC") == "dynamic"
    assert preemption("", "#1 SMP PREEMPT_RT") == "rt"
    assert preemption("", "#1 SMP PREEMPT") == "full"
    assert preemption("", "#1 SMP") == "none"
    assert group_path("9:name=systemd:/x\n2:cpu,cpuacct:/docker/1\n0::/\n") == "/docker/1"
    assert group_path("0::/user.slice\n") is None
    assert bounding_set("CapEff:\t0\nCapBnd:\t0000000000000400\n") == 0x400
    assert bounding_set("") == 0xFFFF_FFFF_FFFF_FFFF


def test_facts_of_this_machine_leave_nothing_behind(tmp_path: Path) -> None:
    facts = gather(tmp_path / "runs" / "deeper")
    assert facts.directory == tmp_path and list(tmp_path.iterdir()) == []
    assert facts.cores and facts.free_bytes > 0 and facts.sync_ms is not None
    assert facts.probed.scheduler.startswith("SCHED_")
    assert gather(Path("/proc")).sync_ms is None


@dataclass(frozen=True)
class Told:
    """What the commands below said, and where."""

    place: Path
    measured: subprocess.CompletedProcess[str]
    foretold: subprocess.CompletedProcess[str]
    refused: subprocess.CompletedProcess[str]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Told:
    """Side by side: the one that measures mostly waits."""
    place, other = tmp_path_factory.mktemp("doctor"), tmp_path_factory.mktemp("without")
    with ThreadPoolExecutor(1) as pool:
        measured = pool.submit(tenuto, "doctor", "--seconds", "1.2", cwd=place)
        foretold = without_privileges("doctor", "--seconds", "0", cwd=other)
        arguments = ["env", "pointmass", "--agent.rt", "require", "--run-dir", "run"]
        refused = without_privileges(*arguments, cwd=other)
        return Told(place, measured.result(), foretold, refused)


def test_the_real_command(told: Told) -> None:
    done = told.measured
    granted = 'agent.rt = "require" is granted here' in done.stdout
    assert done.returncode == (0 if granted else 1), done.stderr
    assert "SCHED_FIFO" in done.stdout and "round trip" in done.stdout and "without any of it" in done.stdout
    assert list(told.place.iterdir()) == []


def without_privileges(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """`tenuto` without capabilities and real-time limits, whoever runs the tests."""
    drop = "setpriv --bounding-set=-all" if os.geteuid() == 0 else ""
    script = f'ulimit -r 0; ulimit -l 64; exec {drop} "$@"'
    command = ["bash", "-c", script, "bash", *command_line(*arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=30, check=False)


def test_without_privileges_it_foretells_what_require_does(told: Told) -> None:
    assert told.foretold.returncode == 1
    assert "is refused here for want of SCHED_FIFO, locked memory" in told.foretold.stdout
    assert "prlimit" in told.foretold.stdout or "docker run --cap-add SYS_NICE" in told.foretold.stdout
    assert told.refused.returncode == 2
    assert "env_server is refused SCHED_FIFO, locked memory" in told.refused.stderr


def test_wrong_input(tmp_path: Path) -> None:
    done = tenuto("doctor", "--seconds", "0.5", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("tenuto: seconds = 0.5: must be 0, or above 1")
