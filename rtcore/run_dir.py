"""The directory of one run: where everything lies, and how it is made."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path

import msgspec
from msgspec.structs import replace

from rtcore import socket_dir, tally
from rtcore.config import ConfigError, RunConfig
from rtcore.config_check import check
from rtcore.config_io import dump_toml, load_toml
from rtcore.files import write_atomic
from rtcore.messages import Policy, Stats

_LOGGER = logging.getLogger(__name__)
_FOLDERS = ("learner", "logs")


class RunDir:
    """A run's directory. Constructing one touches nothing; `create` and `open` do.

    Attributes:
        path: absolute, once it comes from `create` or `open`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._made_parents: list[Path] = []

    @classmethod
    def create(cls, path: Path, config: RunConfig) -> RunDir:
        """Make the directory of a new run and save its configuration. A failure leaves nothing behind.

        Raises:
            ConfigError: a field is out of range, the path exists, or it cannot be made.
        """
        check(config)
        run = cls(_absolute(path))
        try:
            run._make(dump_toml(config).encode())
            run.remove_socket_dir()  # of an earlier run at this path: nobody has joined this one
        except FileExistsError as error:
            raise ConfigError("run_dir", str(run.path), "must not exist yet") from error
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ConfigError("run_dir", str(run.path), f"must be a path to write to ({reason})") from error
        return run

    @classmethod
    def open(cls, path: Path) -> RunDir:
        """The directory of a run that was made before.

        Raises:
            ConfigError: there is none.
        """
        run = cls(_absolute(path))
        if not run.config_path.is_file():
            raise ConfigError("run_dir", str(run.path), "must be a run's directory, with run.toml in it")
        return run

    @property
    def run_name(self) -> str:
        """The directory's name, fit for the keys of the bus: what is odd in it becomes `_`."""
        return re.sub(r"[^A-Za-z0-9_.-]", "_", self.path.name) or "run"

    @property
    def config_path(self) -> Path:
        """`run.toml`: the configuration as resolved."""
        return self.path / "run.toml"

    @property
    def recording_path(self) -> Path:
        """`recording.rrd`."""
        return self.path / "recording.rrd"

    @property
    def summary_path(self) -> Path:
        """`summary.json`."""
        return self.path / "summary.json"

    @property
    def learner_dir(self) -> Path:
        """The learner's own: checkpoints, published policies, replay."""
        return self.path / "learner"

    @property
    def policy_path(self) -> Path:
        """`learner/policy.msgpack`: the newest published policy, as it went over the bus."""
        return self.learner_dir / "policy.msgpack"

    def read_policy(self) -> Policy | None:
        """The newest published policy; None if none was, or if the file is damaged, which is logged."""
        return _read_policy(self.policy_path)

    def adopted_path(self, agent: str) -> Path:
        """`agent/policy.msgpack`, or of a fleet's agent `agent/policy.2.msgpack`: the newest policy that it
        took, where no learner keeps one."""
        return self.path / "agent" / f"policy{_number(agent)}.msgpack"

    def read_adopted(self, agent: str) -> Policy | None:
        """What is in `adopted_path`; None as in `read_policy`."""
        return _read_policy(self.adopted_path(agent))

    @property
    def logs_dir(self) -> Path:
        """Logs and final ledgers, of all processes."""
        return self.path / "logs"

    @property
    def world_path(self) -> Path:
        """`world.mjb`: the compiled MuJoCo model to draw, if the world has one; a board lies beside it."""
        return self.path / "world.mjb"

    def log_path(self, process: str) -> Path:
        """`logs/<process>.jsonl`."""
        return self.logs_dir / f"{_plain(process)}.jsonl"

    def stats_path(self, process: str, incarnation: int) -> Path:
        """`logs/<process>-<incarnation>.stats`: the last ledger of one life of a process."""
        return self.logs_dir / f"{_plain(process)}-{incarnation}.stats"

    def tally_path(self, process: str, incarnation: int) -> Path:
        """`logs/<process>-<incarnation>.tally`: the counters of one life of a process, at every instant."""
        return self.logs_dir / f"{_plain(process)}-{incarnation}.tally"

    @property
    def epoch_path(self) -> Path:
        """`epoch.json`: when the run began (`rtcore.epoch`)."""
        return self.path / "epoch.json"

    def lives_path(self, env_server: str) -> Path:
        """`epoch.json`, or of a fleet's env server `epoch.2.json`: the same with its own lives."""
        return self.path / f"epoch{_number(env_server)}.json"

    def config(self) -> RunConfig:
        """The run's configuration, checked: people edit `run.toml`.

        Raises:
            ConfigError: it cannot be read, or a field is wrong.
        """
        config = load_toml(self.config_path)
        check(config)
        return config

    def write_final_stats(self, stats: Stats) -> None:
        """Keep a process's last ledger for the summary.

        Raises:
            OSError: it cannot be written.
        """
        write_atomic(self.stats_path(stats.process, stats.incarnation), msgspec.msgpack.encode(stats))

    def read_final_stats(self) -> list[Stats]:
        """The ledgers of all lives, by process and incarnation: the last words, with the counters of the
        tally where they are higher; of a life that was killed, `final` is false and only the tally's counters
        are there. A file that cannot be read is logged and left out.
        """
        found: dict[tuple[str, int], Stats] = {}
        for path in self.logs_dir.glob("*.stats"):
            try:
                stats = msgspec.msgpack.decode(path.read_bytes(), type=Stats)
            except (OSError, ValueError, RecursionError) as error:
                _LOGGER.warning("%s left out of the summary: %s", path.name, error)
                continue
            found[stats.process, stats.incarnation] = stats
        for life, counters in self._tallies():
            stats = found.get(life) or Stats(
                process=life[0], incarnation=life[1], seq=0, at_ns=0, final=False, counters={}, gauges={},
                histograms={},
            )  # fmt: skip
            found[life] = replace(stats, counters=tally.raised(stats.counters, counters))
        return [found[life] for life in sorted(found)]

    def next_incarnation(self, process: str, wall_ns: int) -> int:
        """A number for a life that begins at Unix time `wall_ns`: greater than that of every life of the
        process that left anything here, whatever became of the clock."""
        earlier = [
            int(found[1])
            for path in self.logs_dir.glob(f"{_plain(process)}-*")
            if (found := re.fullmatch(rf"{re.escape(process)}-(\d{{1,19}})\.(stats|tally)", path.name))
        ]
        return max([wall_ns, *(life + 1 for life in earlier)])

    def _tallies(self) -> Iterator[tuple[tuple[str, int], dict[str, int]]]:
        for path in self.logs_dir.glob("*.tally"):
            life = re.fullmatch(r"([A-Za-z0-9_.-]+)-(\d{1,19})\.tally", path.name)
            if life is None:
                continue
            try:
                counters = tally.read(path)
            except OSError as error:
                _LOGGER.warning("%s left out of the summary: %s", path.name, error)
                continue
            yield (life[1], int(life[2])), counters

    def socket_dir(self) -> Path:
        """The directory of the run's unix sockets, made if need be; see `rtcore.socket_dir.make`.

        Raises:
            ConfigError: it cannot be made, or others could reach into it.
        """
        return socket_dir.make(self.path)

    def remove_socket_dir(self) -> None:
        """Remove the sockets' directory with what is stale in it; see `rtcore.socket_dir.remove`."""
        socket_dir.remove(self.path)

    def remove_if_empty(self) -> bool:
        """Take `create` back after a failed start: if no process has written anything yet, remove the
        directory, and the parents that were made for it. Says whether it did."""
        folders = [folder for name in (*_FOLDERS, "link") if (folder := self.path / name).is_dir()]
        expected = {self.config_path, *folders}
        if set(self.path.iterdir()) != expected or any(any(folder.iterdir()) for folder in folders):
            return False
        with suppress(OSError):  # none, or sockets in it
            socket_dir.path_for(self.path).rmdir()
        for folder in folders:
            _rmdir(folder)
        self.config_path.unlink()
        self.path.rmdir()
        with suppress(OSError):  # somebody else uses it by now
            for parent in reversed(self._made_parents):
                parent.rmdir()
        return True

    def _make(self, config: bytes) -> None:
        """Make the directory; take every step back if one fails or is interrupted."""
        if os.path.lexists(self.path):
            raise FileExistsError
        with ExitStack() as undo:
            for parent in [parent for parent in reversed(self.path.parents) if not parent.exists()]:
                with suppress(FileExistsError):  # another run made it meanwhile
                    parent.mkdir()
                    undo.callback(_rmdir, parent)
                    self._made_parents.append(parent)
            for folder in (self.path, *(self.path / name for name in _FOLDERS)):
                folder.mkdir()
                undo.callback(_rmdir, folder)
            undo.callback(self.config_path.unlink, missing_ok=True)
            write_atomic(self.config_path, config)
            undo.pop_all()


def default_run_path(root: Path, preset: str, now: datetime) -> Path:
    """`<root>/<UTC time, like 20260131T235959Z>-<preset>`; `now` knows its time zone."""
    return root / f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}-{preset}"


def latest(root: Path) -> RunDir | None:
    """The newest run below `root`: the one whose `run.toml` was written last. None if there is none."""
    configs = [path for path in root.glob("*/run.toml") if path.is_file()]
    if not configs:
        return None
    newest = max(configs, key=lambda path: (path.stat().st_mtime_ns, path.parent.name))
    return RunDir(_absolute(newest.parent))


def _absolute(path: Path) -> Path:
    # Path.absolute would keep "..", and the run's name with it.
    return Path(os.path.abspath(path))  # noqa: PTH100


def _read_policy(path: Path) -> Policy | None:
    try:
        return msgspec.msgpack.decode(path.read_bytes(), type=Policy)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        _LOGGER.warning("%s: %s", path, error)
        return None


def _plain(process: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]+(\.\d+)?", process):
        raise ValueError(f"process = {process!r}: must be a plain name")
    return process


def _number(process: str) -> str:
    """What tells a fleet's processes of one role apart, with the dot; empty where there is one."""
    _, dot, number = process.partition(".")
    return dot + number


def _rmdir(path: Path) -> None:
    with suppress(OSError):
        path.rmdir()
