"""Placement: the decisions as a table, the deeds in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rtcore import channels, realtime
from rtcore.config import ConfigError
from rtcore.crew import Crew
from rtcore.realtime import FIFO, MEMORY, Placement, Plan, Privileges, RealtimeError, plan

ROOT = Path(__file__).parents[2]
ALL = Privileges(max_priority=99, lock_memory=True)
NONE = Privileges(max_priority=0, lock_memory=False)


def acting(role: str, fifo: int | None, core: int, *, lock: bool, missing: tuple[str, ...] = ()) -> Plan:
    return Plan(role, fifo, (core,), None, lock_memory=lock, freeze_collector=True, missing=missing)


def resting(role: str, cores: tuple[int, ...], nice: int | None) -> Plan:
    return Plan(role, None, cores, nice, lock_memory=False, freeze_collector=False, missing=())


@pytest.mark.parametrize("rt", ["auto", "require"])
@pytest.mark.parametrize("role", ["env_server", "agent_service"])
def test_the_acting_pair_shares_the_first_core(role: str, rt: realtime.Rt) -> None:
    assert plan(role, rt, (0, 1), ALL) == acting(role, 50, 0, lock=True)
    assert plan(role, rt, (7, 3, 5), ALL) == acting(role, 50, 3, lock=True)  # of those it may use
    assert plan(role, rt, (2,), ALL) == acting(role, 50, 2, lock=True)
    assert plan(role, rt, (0, 1), NONE) == acting(role, None, 0, lock=False, missing=(FIFO, MEMORY))
    assert plan(role, rt, (0, 1), Privileges(20, lock_memory=False)) == acting(
        role, 20, 0, lock=False, missing=(MEMORY,)
    )
    assert plan(role, rt, (0, 1), Privileges(0, lock_memory=True)) == acting(
        role, None, 0, lock=True, missing=(FIFO,)
    )


@pytest.mark.parametrize("granted", [ALL, NONE])
@pytest.mark.parametrize("rt", ["auto", "require"])
@pytest.mark.parametrize(("role", "nice"), [("learner", 5), ("recorder", 10)])
def test_the_others_keep_off_it_and_are_nice(
    role: str, nice: int, rt: realtime.Rt, granted: Privileges
) -> None:
    assert plan(role, rt, (0, 1), granted) == resting(role, (1,), nice)
    assert plan(role, rt, (3, 5, 7, 9), granted) == resting(role, (5, 7, 9), nice)
    assert plan(role, rt, (4,), granted) == resting(role, (4,), nice)  # no other core to go to


@pytest.mark.parametrize("role", channels.PROCESSES)
def test_off_asks_for_nothing_but_the_collector(role: str) -> None:
    freeze = role in ("env_server", "agent_service")
    assert plan(role, "off", (0, 1), ALL) == Plan(
        role, None, (), None, lock_memory=False, freeze_collector=freeze, missing=()
    )


def test_no_such_role() -> None:
    with pytest.raises(ConfigError, match="role = 'agent': must be one of env_server, agent_service"):
        plan("agent", "auto", (0,), ALL)


def placement(**changes: Any) -> Placement:
    values: dict[str, Any] = {
        "role": "agent_service",
        "scheduler": "SCHED_FIFO 50",
        "nice": 0,
        "cores": (0,),
        "memory_locked": True,
        "timer_slack_ns": 1,
        "collector": "frozen",
        "missing": (),
    }
    return Placement(**{**values, **changes})


def test_a_placement_describes_itself_in_one_line() -> None:
    assert placement().describe() == (
        "SCHED_FIFO 50, nice 0, core 0, memory locked, timer slack 1 ns, collector frozen"
    )
    refused = placement(scheduler="SCHED_OTHER", cores=(1, 2), memory_locked=False, missing=(FIFO, MEMORY))
    assert refused.describe() == (
        "SCHED_OTHER, nice 0, cores 1,2, memory not locked, timer slack 1 ns, collector frozen;"
        " refused: SCHED_FIFO, locked memory"
    )


def test_the_error_names_what_is_missing_and_the_command() -> None:
    error = RealtimeError("env_server", [FIFO, MEMORY])
    assert str(error) == (
        "agent.rt = 'require': env_server is refused SCHED_FIFO, locked memory; to grant it:"
        " sudo prlimit --pid $$ --rtprio=50; sudo prlimit --pid $$ --memlock=unlimited;"
        " then start again from that shell (`tenuto doctor` knows other ways)"
    )
    assert error.missing == (FIFO, MEMORY)


PRELUDE = """
import contextlib, dataclasses, gc, json, os, resource, sys
def limit(kind, value):
    resource.setrlimit(kind, (value, value))
def drop():
    "Become an ordinary user."
    limit(resource.RLIMIT_RTPRIO, 0)
    limit(resource.RLIMIT_MEMLOCK, 65536)
    with contextlib.suppress(PermissionError):  # ordinary already, or a root without capabilities
        os.setgroups([])
        os.setresgid(65534, 65534, 65534)
        os.setresuid(65534, 65534, 65534)
from rtcore import libc, realtime
def show(placement):
    print(json.dumps(dataclasses.asdict(placement)))
"""


def in_process(code: str) -> list[Any]:
    """What a fresh Python prints, line by line as JSON. Its modules are loaded before it drops privileges."""
    done = subprocess.run(
        [sys.executable, "-c", PRELUDE + code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_auto_takes_what_it_gets_and_says_what_it_got() -> None:
    placed, collecting, slack = in_process("""
show(realtime.enter("env_server", "auto"))
print(json.dumps(gc.isenabled()))
print(json.dumps(libc.prctl(libc.PR_GET_TIMERSLACK)))
""")
    assert placed["cores"] == [min(os.sched_getaffinity(0))]
    assert placed["scheduler"] in ("SCHED_FIFO 50", "SCHED_OTHER")
    assert (placed["scheduler"] == "SCHED_OTHER") == (FIFO in placed["missing"])
    assert placed["memory_locked"] == (MEMORY not in placed["missing"])
    assert placed["collector"] == "frozen"
    assert not collecting
    assert placed["timer_slack_ns"] == slack <= 1


def test_an_ordinary_user_gets_the_core_and_the_timer_slack() -> None:
    (placed,) = in_process('drop(); show(realtime.enter("agent_service", "auto"))')
    assert placed == {
        "role": "agent_service",
        "scheduler": "SCHED_OTHER",
        "nice": os.getpriority(os.PRIO_PROCESS, 0),
        "cores": [min(os.sched_getaffinity(0))],
        "memory_locked": False,
        "timer_slack_ns": 1,
        "collector": "frozen",
        "missing": [FIFO, MEMORY],
    }


def test_a_refusal_that_the_limits_did_not_foretell_is_reported_and_not_raised() -> None:
    (placed,) = in_process("""
drop()
plan = realtime.plan("env_server", "auto", realtime.allowed_cores(), realtime.Privileges(99, True))
show(realtime.apply(plan))
""")
    assert placed["scheduler"] == "SCHED_OTHER"
    # Locking within the limit of 64 KiB fails, for an interpreter is larger.
    assert (placed["memory_locked"], placed["missing"]) == (False, [MEMORY, FIFO])


def test_no_fifo_without_pinning() -> None:
    (placed,) = in_process("""
def refuse(*_):
    raise PermissionError
os.sched_setaffinity = refuse
plan = realtime.plan("env_server", "auto", realtime.allowed_cores(), realtime.Privileges(99, False))
show(realtime.apply(plan))
""")
    assert placed["scheduler"] == "SCHED_OTHER"
    assert placed["missing"] == [MEMORY, "pinning", FIFO]


def test_require_raises_for_an_ordinary_user() -> None:
    (text,) = in_process("""
drop()
try:
    realtime.enter("env_server", "require")
except realtime.RealtimeError as error:
    print(json.dumps(str(error)))
""")
    assert "env_server is refused SCHED_FIFO, locked memory" in text
    assert "prlimit --pid $$ --rtprio=50" in text


def test_require_asks_nothing_special_of_the_learner() -> None:
    (placed,) = in_process('drop(); show(realtime.enter("learner", "require"))')
    assert placed["missing"] == []


@pytest.mark.parametrize(("role", "nice"), [("learner", 5), ("recorder", 10)])
def test_background_roles_leave_the_first_core_with_all_their_threads(role: str, nice: int) -> None:
    placed, others = in_process(f"""
import threading
done = threading.Event()
early = threading.Thread(target=done.wait)
early.start()
show(realtime.enter("{role}", "auto"))
thread = early.native_id
print(json.dumps([sorted(os.sched_getaffinity(thread)), os.getpriority(os.PRIO_PROCESS, thread)]))
done.set()
""")
    first, *rest = sorted(os.sched_getaffinity(0))
    cores = rest or [first]
    expected_nice = max(nice, os.getpriority(os.PRIO_PROCESS, 0))
    assert (placed["cores"], placed["nice"], placed["missing"]) == (cores, expected_nice, [])
    assert (placed["scheduler"], placed["collector"]) == ("SCHED_OTHER", "on")
    assert others == [cores, expected_nice]


def test_a_process_that_is_nicer_already_stays_so() -> None:
    (placed,) = in_process('os.nice(19); show(realtime.enter("learner", "auto"))')
    assert placed["nice"] == 19


@pytest.mark.parametrize(
    ("count", "hz", "available", "cores"),
    [
        (1, 1000.0, 8, 1),  # a pair has one core
        (4, 200.0, 8, 1),  # 4 * 200 * 0.4 ms = 0.32 of a core: one promises 0.5
        (2, 625.0, 8, 1),  # exactly 0.5
        (4, 500.0, 2, 2),  # 0.8
        (4, 500.0, 1, 1),
        (4, 2000.0, 16, 4),  # no more than pairs
        (16, 200.0, 16, 3),  # 1.28
    ],
)
def test_a_fleet_shares_as_few_cores_as_carry_it(count: int, hz: float, available: int, cores: int) -> None:
    assert Crew(0, count, hz).cores(available) == cores
    assert Crew(0, count, hz).fills(available) is ((count, hz, available) == (4, 500.0, 2))


def test_pairs_of_a_fleet_are_dealt_to_its_cores_and_the_others_keep_off() -> None:
    crews = [Crew(number, 4, 500.0) for number in range(4)]
    for role in ("env_server", "agent_service"):
        dealt = [plan(role, "auto", (3, 5, 7, 9), ALL, crew).cores for crew in crews]
        assert dealt == [(3,), (5,), (3,), (5,)]
    assert plan("learner", "auto", (3, 5, 7, 9), ALL, Crew(0, 4, 500.0)).cores == (7, 9)
    assert plan("recorder", "auto", (0, 1), ALL, Crew(0, 4, 500.0)).cores == (0, 1)


def test_who_watches_a_fleet_keeps_off_all_of_its_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    pinned: list[tuple[int, ...]] = []
    monkeypatch.setattr(realtime, "allowed_cores", lambda: (0, 1, 2, 3))
    monkeypatch.setattr(realtime, "pin", lambda cores: pinned.append(tuple(cores)))
    with realtime.out_of_the_way("auto", Crew(0, 4, 500.0)):
        assert pinned == [(2, 3)]
    assert pinned == [(2, 3), (0, 1, 2, 3)]


def test_off_changes_neither_cores_nor_scheduler() -> None:
    (placed,) = in_process('show(realtime.enter("agent_service", "off"))')
    assert placed["cores"] == sorted(os.sched_getaffinity(0))
    assert (placed["scheduler"], placed["memory_locked"], placed["missing"]) == ("SCHED_OTHER", False, [])
    assert (placed["collector"], placed["timer_slack_ns"]) == ("frozen", 1)


def test_privileges_follow_the_limits_of_an_ordinary_user() -> None:
    (granted,) = in_process("drop(); print(json.dumps(dataclasses.asdict(realtime.privileges())))")
    assert granted == {"max_priority": 0, "lock_memory": False}


@pytest.mark.parametrize(("limit", "expected"), [(0, 0), (20, 20), (50, 50), ("resource.RLIM_INFINITY", 99)])
def test_a_limit_grants_as_much_as_it_says(limit: object, expected: int) -> None:
    (granted,) = in_process(f"""
drop()
resource.getrlimit = lambda kind: ({limit}, {limit})
print(json.dumps(dataclasses.asdict(realtime.privileges())))
""")
    assert granted == {"max_priority": expected, "lock_memory": expected == 99}


@pytest.mark.skipif(len(realtime.allowed_cores()) < 2, reason="needs a second core")
def test_who_only_watches_keeps_off_the_first_core_and_comes_back() -> None:
    allowed = realtime.allowed_cores()
    with realtime.out_of_the_way("off"):
        assert realtime.allowed_cores() == allowed
    with realtime.out_of_the_way("auto"):
        assert realtime.allowed_cores() == allowed[1:]
    assert realtime.allowed_cores() == allowed
