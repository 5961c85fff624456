"""What the timing benchmarks share: the real processes as one measured run, helpers as JSON, results on disk.

A run here is what `tenuto run` starts, without its screen: the same processes, supervisor and summary.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.machine import facts
from benchmarks.outcome import Outcome, share_above
from env_server.worlds.registry import resolve
from launcher import presets
from launcher.stealing import StealMeter
from launcher.summary import Summary, discrepancies, summarise
from launcher.supervisor import Interrupts, Supervisor, command_for
from launcher.totals import add_up
from rtcore import channels
from rtcore.config import RunConfig
from rtcore.config_check import check
from rtcore.files import write_atomic
from rtcore.messages import Architecture, Policy, Stats
from rtcore.monotonic import MonotonicClock
from rtcore.realtime import Rt
from rtcore.run_dir import RunDir
from rtcore.weights import expected_shapes, pack, sha256

ROOT = Path(__file__).resolve().parents[1]
# Takes from root what an ordinary user may not ask of the scheduler: the capabilities, real-time priority,
# more than 8 MB of locked memory. The user stays the same, so that the files can be read.
GIVE_UP = (
    "prlimit", "--rtprio=0:0", "--memlock=8388608:8388608", "setpriv", "--bounding-set=-sys_nice,-ipc_lock",
    "--inh-caps=-sys_nice,-ipc_lock",
)  # fmt: skip
ACTING = (channels.ENV_SERVER, channels.AGENT)
LEARNING = (*ACTING, channels.LEARNER)
CHILD_LIMIT_S = 60.0  # beyond its measuring time, for the start and the end
WAIT_FOR_AGENT_S = 5.0  # without a learner the env server waits so long in vain; an agent needs 1 to 3
LATE_SHARE = 0.1  # a tick that begins later than this share of its period is late


class BenchmarkError(RuntimeError):
    """Something that was to be measured did not run."""


def world(name: str, *, hz: float, seconds: float, rt: Rt) -> RunConfig:
    """A preset at a rate, for so many seconds, unrecorded."""
    base = presets.load(name)
    env = replace(base.env, hz=hz, speed=None)
    config = replace(
        base,
        duration_s=seconds,
        env=env,
        agent=replace(base.agent, rt=rt),
        recorder=replace(base.recorder, record=False),
    )
    check(config)
    return replace(config, env=resolve(env))


def run_system(
    config: RunConfig,
    processes: Sequence[str] = LEARNING,
    *,
    hidden: Sequence[int] = (),
    prefix: Sequence[str] = (),
    on_poll: Callable[[], None] = lambda: None,
) -> Outcome:
    """Run the real processes until `duration_s` is over.

    Args:
        config: the run, resolved.
        processes: who takes part; the env server first.
        hidden: the agent acts from the first tick with a random network of these layers; (): the agent
            begins with the uniformly random policy.
        prefix: put before each process's command line, `unprivileged()` for one.
        on_poll: called every 50 ms.

    Raises:
        BenchmarkError: a process failed, or the counts do not reconcile.
    """
    if channels.LEARNER not in processes:
        wait_s = min(config.env.start_wait_s, WAIT_FOR_AGENT_S)
        config = replace(config, env=replace(config.env, start_wait_s=wait_s))
    with tempfile.TemporaryDirectory(prefix="tenuto-") as directory:
        run_dir = RunDir.create(Path(directory) / "run", config)
        if hidden:
            write_atomic(run_dir.policy_path, msgspec.msgpack.encode(random_policy(config, hidden)))
        commands = {name: [*prefix, *command_for(name, run_dir.path)] for name in processes}
        supervisor, interrupts = Supervisor(commands, run_dir.logs_dir), Interrupts()
        clock, steal = MonotonicClock(), StealMeter()
        began_ns = clock.now_ns()
        with interrupts.counted(), supervisor.started():
            end = supervisor.supervise(interrupts, lambda _: on_poll())
        wall_s, stolen = (clock.now_ns() - began_ns) / 1e9, steal.elapsed_s()
        run_dir.remove_socket_dir()
        if end.reason in ("interrupted", "killed"):
            raise KeyboardInterrupt
        if end.failures or end.forced:
            outputs = "\n".join(f"{one}\n{one.output}" for one in end.failures)
            raise BenchmarkError(f"{outputs or end.forced} (ended: {end.reason})")
        stats: dict[str, list[Stats]] = {}
        for ledger in run_dir.read_final_stats():
            stats.setdefault(ledger.process, []).append(ledger)
        granted = {name: placement(run_dir.log_path(name)) for name in processes}
    summary = summarise(config, run_dir.run_name, stats, wall_s=wall_s, restarts={}, ended=end.reason)
    failing = [line for line in discrepancies(summary) if channels.LEARNER in processes]
    if hidden:  # the agent received one policy more than the learner published
        failing = [line for line in failing if not line.startswith("policies.unreceived")]
    if failing:
        raise BenchmarkError("; ".join(failing))
    if summary["loop_us"]["p50"] is None:
        raise BenchmarkError("the agent answered nothing")
    found = from_summary(summary, stats, config, stolen)
    return replace(found, more={**found.more, "placement": granted})


def unprivileged() -> tuple[str, ...]:
    """What to put before a command so that it has an ordinary user's privileges; nothing if it has them."""
    return GIVE_UP if os.geteuid() == 0 else ()


def from_summary(
    summary: Summary, stats: dict[str, list[Stats]], config: RunConfig, stolen: float | None
) -> Outcome:
    """A run of the real system as an outcome."""
    deadlines = summary["deadlines"]
    pacing = add_up(stats.get(channels.ENV_SERVER, [])).histograms["pacing"]
    assert config.env.hz is not None
    more = {
        "skipped": deadlines["skipped"],
        "missed_by_cause": deadlines["missed_by_cause"],
        "reaction_us": summary["reaction_us"],
        "late_share": share_above(pacing, LATE_SHARE * 1e9 / config.env.hz),
        "rate_hz": summary["ticks"] / (summary["ticks"] + deadlines["skipped"]) * config.env.hz,
        "updates_per_s": summary["learner"]["updates_per_s"],
        "policies": summary["policies"],
        "recorder": summary["recorder"],
    }
    return Outcome(
        ticks=summary["ticks"],
        missed=deadlines["missed"] + deadlines["skipped"],
        overruns=deadlines["overruns"],
        loop_us=summary["loop_us"],
        pacing_us=summary["pacing_error_us"],
        stolen_s=stolen,
        more=more,
    )


def placement(log: Path) -> str:
    """The line of a process's log that says what scheduling it got; empty if there is none."""
    texts = (json.loads(line)["text"] for line in log.read_text().splitlines())
    return next((text for text in texts if "SCHED_" in text), "")


def random_policy(config: RunConfig, hidden: Sequence[int]) -> Policy:
    """A policy for the world of `config` that nobody has trained; the same for the same sizes."""
    from env_server.worlds.registry import make_world

    with contextlib.closing(make_world(config.env, 0)) as made:
        observation_dim = made.observation_dim + config.env.observe_actions * made.action_dim
        return policy(observation_dim, made.action_dim, hidden)


def policy(observation_dim: int, action_dim: int, hidden: Sequence[int]) -> Policy:
    """A policy of these sizes with small random weights."""
    architecture = Architecture(
        kind="tanh_gaussian_mlp", observation_dim=observation_dim, action_dim=action_dim, hidden=list(hidden)
    )
    rng = np.random.default_rng(0)
    shapes = expected_shapes(architecture)
    arrays = {name: (0.05 * rng.standard_normal(shape)).astype(np.float32) for name, shape in shapes.items()}
    weights = pack(arrays)
    return Policy(
        version=1, window=0, iterate=1, algo="sac", architecture=architecture, weights=weights,
        sha256=sha256(weights), created_ns=MonotonicClock().now_ns(),
    )  # fmt: skip


@contextmanager
def background_child(module: str, arguments: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """`python -m module` beside the block; it is ended with it. Its first line says that it is ready."""
    with subprocess.Popen(
        [sys.executable, "-m", module, *arguments], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as child:
        try:
            assert child.stdout is not None
            if not child.stdout.readline():
                raise BenchmarkError(f"{module} {' '.join(arguments)} did not become ready")
            yield child
        finally:
            child.terminate()
            try:
                child.wait(5)
            except subprocess.TimeoutExpired:
                child.kill()


def child_result(
    module: str, arguments: Sequence[str], *, seconds: float, prefix: Sequence[str] = ()
) -> dict[str, Any]:
    """Run `python -m module` to its end; its last line of output, which is JSON.

    Raises:
        BenchmarkError: it failed, or took too long.
    """
    command = [*prefix, sys.executable, "-m", module, *arguments]
    try:
        done = subprocess.run(
            command, cwd=ROOT, capture_output=True, text=True, timeout=seconds + CHILD_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise BenchmarkError(f"{module} took longer than {error.timeout:.0f} s") from error
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        raise BenchmarkError(f"{module} ended with code {done.returncode}: {done.stderr[-2000:]}")
    found: dict[str, Any] = json.loads(lines[-1])
    return found


def write_result(name: str, arguments: Any, packages: Sequence[str], found: dict[str, Any]) -> Path:
    """`<out>/<date>-<name>.json`: the measurement, what it was made on, and how it was asked for.

    Args:
        name: of the benchmark.
        arguments: its dataclass of arguments, with the directory in `out`.
        packages: whose versions matter.
        found: the rest. Benchmarks that take long write again and again, so that a failure loses little.
    """
    settings, now = asdict(arguments), datetime.now(UTC)
    out: Path = settings.pop("out")
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{now:%Y-%m-%d}-{name}.json"
    head = {
        "benchmark": name,
        "date": now.isoformat(timespec="seconds"),
        "machine": facts(packages),
        "arguments": settings,
    }
    path.write_text(json.dumps(head | found, indent=1) + "\n")
    return path
