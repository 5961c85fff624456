"""`tenuto chaos`: run the system, break it on purpose, and judge whether it kept its promises."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from launcher import options
from launcher.chaos.clause import passed
from launcher.chaos.evidence import gather
from launcher.chaos.faults import Done, Execution, Lives, Victims
from launcher.chaos.judge import judge
from launcher.chaos.plan import Fault, Kind, parse_kinds, plan
from launcher.chaos.report import as_json, render
from launcher.child_run import started
from launcher.cli import DONE, FAILED, INTERRUPTED, CommandError
from launcher.parsing import HELP_FLAGS, given, value_after
from launcher.run import default_path
from launcher.supervisor import Interrupts
from rtcore import cast, epoch
from rtcore.config import ConfigError, RunConfig
from rtcore.files import write_atomic
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir

NAME = "chaos.json"
DURATION_S = 600.0
BEGIN_LIMIT_S = 60.0  # until the env server has set T0: it waits 15 s for the others, who may be slow to load
POLL_S = 0.05
INTERFACES = Path("/sys/class/net")
SETTLE_S = 10.0  # after the last fault, in a run that goes on
END_LIMIT_S = 40.0  # an interrupted run ends within 5 s, and is mended within 2; then it is killed


@dataclass(frozen=True, kw_only=True)
class ChaosOptions(options.RunOptions):
    """A run, and what shall befall it."""

    kills: int = 60
    """How many faults, of all kinds."""
    kinds: str = "kill,stop"
    """Which: kill (-9), stop (for 0.1 to 3 s), slow (stopped half of the time), fill (a full disk, for
    recorder or learner), partition (--interface down); the last three for 1 to 5 s."""
    interface: str = ""
    """For partition: the network interface that leads to the run's other hosts."""
    attach: Path | None = None
    """The directory of a run that goes on already, on this machine: break that one, and leave it running."""


@dataclass(frozen=True)
class Attack:
    """One execution of a plan.

    Attributes:
        ended: the run is over.
        interrupted: somebody wanted the end.
        code: of `tenuto run`; None: it was not ours, or had to be killed.
    """

    run_dir: RunDir
    done: Sequence[Done]
    ended: bool
    interrupted: bool = False
    code: int | None = None


def chaos(argv: Sequence[str]) -> int:
    """`tenuto chaos [PRESET] ...`."""
    attach = None if _wants_help(argv) else value_after("--attach", argv)
    if attach is not None:
        return _attached(argv, Path(attach))
    if not any(given(flag, argv) for flag in ("--duration-s", "--config")):
        argv = [*argv, "--duration-s", f"{DURATION_S:g}"]
    description = options.describe(
        "Learn in real time while processes are killed and stopped at random, and judge what became of it; "
        f"for {DURATION_S:g} s unless --duration-s says otherwise."
    )
    config, chosen = options.read(ChaosOptions, argv, prog="tenuto chaos", description=description)
    if not config.recorder.record:
        raise ConfigError("recorder.record", False, "must be true: the recording is judged, and judged by")
    kinds, faults = _planned(config, chosen)
    # Deaths by our hand are not what the limit is for.
    limit = config.supervise.limit + chosen.kills
    config = replace(config, supervise=replace(config.supervise, limit=limit))
    path = chosen.run_dir or default_path(config)
    if os.path.lexists(path):
        raise ConfigError("run_dir", str(path), "must not exist yet")
    attack = _run(config, path, faults, chosen.interface)
    return _conclude(attack, config.seed, config.duration_s, chosen.kills, kinds)


def _planned(config: RunConfig, chosen: ChaosOptions) -> tuple[tuple[Kind, ...], tuple[Fault, ...]]:
    """What shall befall the run."""
    kinds = parse_kinds(chosen.kinds)
    faults = plan(config.seed, chosen.kills, config.duration_s, kinds, cast.names(config))
    if "partition" in kinds:
        if not chosen.interface or not (INTERFACES / chosen.interface).exists():
            names = ", ".join(sorted(path.name for path in INTERFACES.iterdir()))
            raise ConfigError("interface", chosen.interface, f"must be one of {names}, for a partition")
        if os.geteuid() != 0:
            raise ConfigError("kinds", chosen.kinds, "only root can take an interface down, for a partition")
    return kinds, faults


def _wants_help(argv: Sequence[str]) -> bool:
    return any(token in HELP_FLAGS for token in argv)


def _attached(argv: Sequence[str], path: Path) -> int:
    """Break a run that goes on, for `duration_s` from now."""
    run_dir = RunDir.open(path)
    argv = [*argv, "--config", str(run_dir.config_path)]
    if not given("--duration-s", argv):
        argv = [*argv, "--duration-s", f"{DURATION_S:g}"]
    config, chosen = options.read(ChaosOptions, argv, prog="tenuto chaos", description="")
    kinds, faults = _planned(config, chosen)
    clock, interrupts = MonotonicClock(), Interrupts()
    beginning = epoch.read(run_dir.epoch_path)
    over = run_dir.summary_path.exists()
    if beginning is None or beginning.boot_id != epoch.this_boot() or over:
        raise CommandError(f"no run goes on in {run_dir.path} on this machine")
    since_s = max(0.0, (clock.now_ns() - beginning.t0_ns) / 1e9)
    faults = tuple(replace(fault, at_s=round(fault.at_s + since_s, 3)) for fault in faults)
    execution = Execution(faults, Victims(Lives(run_dir.path), chosen.interface), clock, beginning.t0_ns)

    def going_on() -> bool:
        return not interrupts.count and not run_dir.summary_path.exists()

    with interrupts.counted():
        execution.run(going_on)
        until_s = time.monotonic() + SETTLE_S
        while going_on() and time.monotonic() < until_s:
            time.sleep(POLL_S)
    ended = run_dir.summary_path.exists()
    attack = Attack(run_dir, execution.done, ended, interrupted=bool(interrupts.count))
    return _conclude(attack, config.seed, config.duration_s, chosen.kills, kinds)


def _run(config: RunConfig, path: Path, faults: Sequence[Fault], interface: str) -> Attack:
    """Start `tenuto run`, break it, wait for its end."""
    interrupts = Interrupts()
    with interrupts.counted(), started(config, path) as child:

        def going_on() -> bool:
            return child.poll() is None and not interrupts.count

        done: Sequence[Done] = [Done(fault, None) for fault in faults]
        run_dir = RunDir(path)
        t0_ns = _beginning_ns(run_dir, going_on)
        if t0_ns is not None:
            run_dir = RunDir.open(path)  # by the path that the processes were given
            execution = Execution(faults, Victims(Lives(run_dir.path), interface), MonotonicClock(), t0_ns)
            execution.run(going_on)
            done = execution.done
        while going_on():
            time.sleep(POLL_S)
        code = _ended(child, interrupts)
    if not run_dir.config_path.is_file():
        raise CommandError(f"there was no run (exit code {code})")
    return Attack(run_dir, done, ended=True, interrupted=bool(interrupts.count), code=code)


def _ended(child: subprocess.Popen[bytes], interrupts: Interrupts) -> int | None:
    """Its exit code once it has ended, which an interrupt asks for, and a second one at once; None: it did
    not.
    """
    limit_s, passed_on = time.monotonic() + END_LIMIT_S, 0
    while (code := child.poll()) is None and time.monotonic() < limit_s:
        if passed_on < min(interrupts.count, 2):
            passed_on += 1
            child.send_signal(signal.SIGINT)
        time.sleep(POLL_S)
    return code


def _beginning_ns(run_dir: RunDir, going_on: Callable[[], bool]) -> int | None:
    """T0, once it is there; None: it does not come."""
    limit_s = time.monotonic() + BEGIN_LIMIT_S
    while going_on() and time.monotonic() < limit_s:
        found = epoch.read(run_dir.epoch_path)
        if found is not None:
            return found.t0_ns
        time.sleep(POLL_S)
    return None


def _conclude(attack: Attack, seed: int, duration_s: float, kills: int, kinds: Sequence[Kind]) -> int:
    """Judge, tell, write it down."""
    run_dir = attack.run_dir
    clauses = judge(gather(run_dir, attack.done, ended=attack.ended))
    about = {"seed": seed, "duration_s": duration_s, "kills": kills, "kinds": list(kinds)}
    found = as_json(run_dir.run_name, about | {"run_code": attack.code}, attack.done, clauses)
    path = run_dir.path / NAME
    write_atomic(path, (json.dumps(found, indent=2) + "\n").encode())
    Console().print(render(run_dir.run_name, attack.done, clauses, path))
    if attack.interrupted:
        return INTERRUPTED
    return DONE if passed(clauses) and not attack.code else FAILED
