"""A secured run as its rogues find it: what is honest, and what they connect with."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from rtcore import channels
from rtcore.channels import Channel, MessageT
from rtcore.codec import Codec, Rejections
from rtcore.config import LinkConfig
from rtcore.log_reader import LogReader
from rtcore.messages import Architecture, Policy, Stats, Step
from rtcore.monotonic import MonotonicClock
from rtcore.run_dir import RunDir
from rtcore.signing import identity, open_signer
from rtcore.zenoh_bus import ZenohBus
from rtcore.zenoh_config import Security, session_config
from rtcore.zenoh_ports import local_ports
from rtcore.zenoh_session import open_session
from tests.agent_service import rig
from tests.rtcore.bus_samples import eventually

ROOT = Path(__file__).parents[2]
CLOCK = MonotonicClock()


def start(role: str, run: RunDir) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", role, "--run", str(run.path)], cwd=ROOT, stdout=subprocess.DEVNULL
    )


@dataclass
class Scene:
    """A run with its honest processes."""

    run: RunDir
    home: Path  # of its keys
    learner: ZenohBus
    recorder: ZenohBus
    architecture: Architecture
    agent: subprocess.Popen[bytes]
    steps: list[Step] = field(default_factory=list)
    newest: dict[tuple[str, int], Stats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.log = LogReader(self.recorder, "*", capacity_batches=10_000)
        self.stats = self.recorder.queue(channels.STATS, "*")
        self.policies = self.learner.publisher(channels.POLICY)

    def look(self) -> None:
        self.steps += self.log.read(CLOCK.now_ns())
        self.newest |= {(s.process, s.incarnation): s for s in (one.message for one in self.stats.drain())}

    def comes(self, holds: Callable[[], bool]) -> bool:
        def look() -> bool:
            self.look()
            return holds()

        return eventually(look)

    def counters(self) -> Counter[str]:
        """Of all lives of env server and agent, as `process.counter`."""
        found: Counter[str] = Counter()
        for (process, _), stats in self.newest.items():
            found.update({f"{process}.{name}": count for name, count in stats.counters.items()})
        return found

    def version(self) -> int:
        """Of the policy that acted last; -1: none has yet."""
        return next((one.policy_version for one in reversed(self.steps) if one.policy_version >= 0), -1)

    def policy(self, version: int, run: str = "run") -> Policy:
        """Signed by the learner."""
        link = LinkConfig(secure=str(self.home))
        plain = rig.policy(version, architecture=self.architecture)
        return open_signer(link, channels.LEARNER, run).sign(plain)

    @contextmanager
    def rogue(self, role: str, home: Path | None = None, *, shows: bool = True) -> Iterator[zenoh.Session]:
        """A session with the certificate of `role` below `home`, or with none, that trusts ours."""
        found = identity(str(home or self.home), role)
        assert found is not None
        security = Security(found, local_ports(self.run.socket_dir()))
        settings: Any = session_config("client", self.run.run_name, self.run.socket_dir(), security=security)
        tls = settings["transport"]["link"]["tls"]
        tls["root_ca_certificate"] = str(self.home / role / "ca.pem")
        if not shows:
            tls["enable_mtls"] = False
            for name in [name for name in tls if name.startswith(("connect_", "listen_"))]:
                del tls[name]
        del settings["access_control"]  # its own rules are no protection from it
        session = open_session(settings)
        try:
            yield session
        finally:
            session.close()  # type: ignore[no-untyped-call]


def send(session: zenoh.Session, channel: Channel[MessageT], key: str, message: MessageT) -> None:
    session.put(key, Codec(channel, Rejections(CLOCK.now_ns)).encode(message))


def linked(session: zenoh.Session) -> bool:
    return eventually(lambda: len(session.info.peers_zid()) >= 2)
