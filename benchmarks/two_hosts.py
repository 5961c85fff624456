"""A secured run on two hosts: a cut cable, a slow line, lost packets. Needs root and `ip`.

    python -m benchmarks.two_hosts [--cut-s 5] [--lines]

The hosts are two network namespaces of this machine, so they share its clock and cores. Env server and agent
are on one, learner and recorder on the other; with `--lines` also with the agent beside the learner, where
the real-time loop crosses the line. Results: benchmarks/results/<date>-two_hosts.json.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from launcher import keys
from launcher.chaos.netlab import CABLE_ADDRESS, LINE_ADDRESS, TwoHosts, missing, two_hosts
from launcher.options import RunOptions, read
from launcher.summary import discrepancies, summarise
from rtcore import channels
from rtcore.config import RunConfig
from rtcore.messages import Stats
from rtcore.run_dir import RunDir

RESULTS = Path(__file__).parent / "results"
SPLIT = {
    channels.ENV_SERVER: "a",
    channels.AGENT: "a",
    channels.LEARNER: "b",
    channels.RECORDER: "b",
}
FAR_AGENT = SPLIT | {channels.AGENT: "b"}
FIRST_PORT = 7447
LINES = ((0.0, 0.0), (1.0, 0.0), (5.0, 0.0), (20.0, 0.0), (0.0, 0.01))  # one way in ms, share lost
SMALL = (
    "--env.unit-s", "0.5", "--env.episode-steps", "100", "--learner.hidden", "64", "64", "--learner.batch",
    "64", "--learner.learning-starts", "100", "--learner.schedule.gamma-f", "1", "--recorder.detail", "light",
)  # fmt: skip

Summary = dict[str, Any]


def config(home: Path, *, hz: float, duration_s: float) -> RunConfig:
    """A small run with the keys in `home`."""
    arguments = ("pointmass", "--env.hz", str(hz), "--duration-s", str(duration_s), *SMALL)
    return read(
        RunOptions, [*arguments, "--link.secure", str(home / "keys")], prog="two_hosts", description=""
    )[0]


@contextmanager
def started(
    hosts: TwoHosts, home: Path, wanted: RunConfig, sides: Mapping[str, str], address: Mapping[str, str]
) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    """All processes, each on its side with the run directory of that side; killed at the end."""
    keys.make(home / "keys", [*CABLE_ADDRESS.values(), *LINE_ADDRESS.values()], now=datetime.now(UTC))
    runs = {side: RunDir.create(home / side / "run", wanted) for side in set(sides.values())}
    ports = {role: FIRST_PORT + index for index, role in enumerate(channels.PROCESSES)}
    children: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for index, role in enumerate(channels.PROCESSES):
            far = [one for one in channels.PROCESSES[:index] if sides[one] != sides[role]]
            command = [sys.executable, "-m", role, "--run", str(runs[sides[role]].path)]
            command += ["--listen", f"tls/0.0.0.0:{ports[role]}"]
            for other in far:
                command += ["--connect", f"tls/{address[sides[other]]}:{ports[other]}"]
            with (home / f"{role}.out").open("wb") as output:
                children[role] = subprocess.Popen(
                    hosts.command(sides[role], command), stdout=output, stderr=subprocess.STDOUT
                )
        yield children
    finally:
        for child in children.values():
            child.kill()
            child.wait()
        for run in runs.values():
            run.remove_socket_dir()


def play(
    hosts: TwoHosts,
    home: Path,
    wanted: RunConfig,
    sides: Mapping[str, str] = SPLIT,
    address: Mapping[str, str] = CABLE_ADDRESS,
    during: Callable[[], None] = lambda: None,
) -> Summary:
    """Run it to its end, with `during` once it ticks; returns its summary, of both hosts' ledgers."""
    with started(hosts, home, wanted, sides, address) as children:
        wait_for_ticks(home / sides[channels.ENV_SERVER] / "run", children[channels.ENV_SERVER])
        during()
        children[channels.ENV_SERVER].wait(wanted.duration_s + 30)
        time.sleep(1.0)  # the recorder and the learner take in what still comes
        for role in (channels.AGENT, channels.LEARNER, channels.RECORDER):
            children[role].terminate()
        for child in children.values():
            child.wait(10)
    stats: dict[str, list[Stats]] = {}
    for side in sorted(set(sides.values())):
        for one in RunDir(home / side / "run").read_final_stats():
            stats.setdefault(one.process, []).append(one)
    summary = summarise(wanted, "run", stats, wall_s=0.0, restarts={}, ended="duration")
    (agent,) = stats[channels.AGENT]
    links = {
        f"{process}.{name}": one.counters.get(name, 0)
        for process, (one,) in stats.items()
        for name in ("link.denied", "link.refused")
    }
    return summary | {"newest_acting": agent.gauges["policy_version"], "links": links}


def wait_for_ticks(run: Path, env_server: subprocess.Popen[bytes]) -> None:
    """Return once the env server says that it ticks."""
    log = RunDir(run).log_path(channels.ENV_SERVER)
    deadline = time.monotonic() + 40
    while not (log.exists() and " Hz" in log.read_text()):
        if time.monotonic() > deadline or env_server.poll() is not None:
            raise TimeoutError(f"no tick; see {run}")
        time.sleep(0.05)


def cut_for(hosts: TwoHosts, before_s: float, cut_s: float) -> Callable[[], None]:
    """What cuts the cable after `before_s`, and restores it after `cut_s`."""

    def during() -> None:
        time.sleep(before_s)
        hosts.cut()
        try:
            time.sleep(cut_s)
        finally:
            hosts.restore()

    return during


def row(summary: Summary) -> Summary:
    """The figures for the table."""
    loop = {name: round(summary["loop_us"][name]) for name in ("p50", "p99", "max")}
    return {
        "ticks": summary["ticks"],
        "missed": summary["deadlines"]["missed"],
        "loop_us": loop,
        "transitions": summary["transitions"],
        "policies": {name: summary["policies"][name] for name in ("published", "adopted")},
        "publish_to_adopt_ms": round(summary["policies"]["publish_to_adopt_ms"]["p50"] or 0.0, 1),
        "newest_acting": summary["newest_acting"],
        "gradient_steps": summary["learner"]["gradient_steps"],
        "recorded_dropped": summary["recorder"]["dropped"],
        "discrepancies": discrepancies(summary),
        "links": summary["links"],
    }


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hz", type=float, default=100.0)
    parser.add_argument("--duration-s", type=float, default=10.0)
    parser.add_argument("--cut-s", type=float, default=5.0)
    parser.add_argument("--lines", action="store_true")
    options = parser.parse_args(argv)
    if lacks := missing():
        sys.exit(f"two_hosts: {lacks}")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the namespaces are removed
    found: dict[str, Summary] = {}

    def take(name: str, summary: Summary) -> None:
        found[name] = row(summary)
        print(name, json.dumps(found[name]), flush=True)

    with two_hosts() as hosts, tempfile.TemporaryDirectory(prefix="tn", dir="/tmp") as place:
        home = Path(place)
        wanted = config(home / "cut", hz=options.hz, duration_s=options.duration_s)
        during = cut_for(hosts, 2.0, options.cut_s)
        take(f"cable cut for {options.cut_s:g} s", play(hosts, home / "cut", wanted, during=during))
        for split, sides in (("agent beside env", SPLIT), ("agent beside learner", FAR_AGENT)):
            for delay_ms, loss in LINES if options.lines else ():
                name = f"{split}, {delay_ms:g} ms, {loss:.0%} lost"
                place = str(home / name.replace(" ", "_"))
                wanted = config(Path(place), hz=options.hz, duration_s=options.duration_s)
                with hosts.line(delay_s=delay_ms / 1e3, loss=loss):
                    take(name, play(hosts, Path(place), wanted, sides, LINE_ADDRESS))
    path = RESULTS / f"{datetime.now(UTC):%Y-%m-%d}-two_hosts.json"
    path.write_text(json.dumps({"hz": options.hz, "duration_s": options.duration_s, "rows": found}, indent=1))


if __name__ == "__main__":
    main()
