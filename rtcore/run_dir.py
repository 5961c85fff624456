"""The directory of one run: where everything lies, how it is made, and how files in it are replaced whole."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import stat
import threading
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from rtcore.channels import PROCESSES
from rtcore.config import ConfigError, RunConfig
from rtcore.config_check import check
from rtcore.config_io import dump_toml, load_toml
from rtcore.messages import Policy, Stats

# The kernel takes 107 bytes for a unix socket's path; 100 leaves room for a longer name than today's.
SOCKET_PATH_BYTES = 100
# Fixed rather than $TMPDIR: all processes of a run must find the same directory, whoever started them.
TEMP = Path("/tmp")

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
        try:
            return msgspec.msgpack.decode(self.policy_path.read_bytes(), type=Policy)
        except FileNotFoundError:
            return None
        except (OSError, msgspec.DecodeError) as error:
            _LOGGER.warning("%s: %s", self.policy_path, error)
            return None

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
        """The last ledgers, by process and incarnation. One that does not decode is logged and left out."""
        found = []
        for path in self.logs_dir.glob("*.stats"):
            try:
                found.append(msgspec.msgpack.decode(path.read_bytes(), type=Stats))
            except (OSError, msgspec.DecodeError) as error:
                _LOGGER.warning("%s left out of the summary: %s", path.name, error)
        return sorted(found, key=lambda stats: (stats.process, stats.incarnation))

    def socket_dir(self) -> Path:
        """The directory of the run's unix sockets (`<process>.sock`), made if need be: private to this
        user, the same for every process of the run, short enough for the kernel and free of what means
        something in an endpoint. It is `link` in the run if that will do, else one below /tmp.

        Raises:
            ConfigError: it cannot be made, or others could reach into it.
        """
        directory = self._socket_path()
        try:
            with suppress(FileExistsError):
                directory.mkdir(mode=0o700)
            found = directory.lstat()
        except OSError as error:
            allowed = f"must be a directory that can be made ({error.strerror})"
            raise ConfigError("run_dir.socket_dir", str(directory), allowed) from error
        mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()
        if not mine or stat.S_IMODE(found.st_mode) & 0o077:
            allowed = f"must be a directory of user {os.geteuid()} with mode 0700"
            raise ConfigError("run_dir.socket_dir", str(directory), allowed)
        return directory

    def remove_socket_dir(self) -> None:
        """Remove the sockets' directory with the stale sockets and locks in it, once every process of the
        run has ended. What else lies there stays, and so does the directory then."""
        directory = self._socket_path()
        if not directory.is_dir() or directory.is_symlink() or directory.stat().st_uid != os.geteuid():
            return
        for process in PROCESSES:
            for name in (f"{process}.sock", f"{process}.sock.lock"):
                (directory / name).unlink(missing_ok=True)
        with suppress(OSError):
            directory.rmdir()

    def remove_if_empty(self) -> bool:
        """Take `create` back after a failed start: if no process has written anything yet, remove the
        directory, and the parents that were made for it. Says whether it did."""
        folders = [folder for name in (*_FOLDERS, "link") if (folder := self.path / name).is_dir()]
        expected = {self.config_path, *folders}
        if set(self.path.iterdir()) != expected or any(any(folder.iterdir()) for folder in folders):
            return False
        with suppress(OSError):  # none, or sockets in it
            self._socket_path().rmdir()
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

    def _socket_path(self) -> Path:
        # Resolved: processes that were given the run by different paths must come to the same answer.
        home = self.path.resolve()
        near = home / "link"
        longest = max(len(os.fsencode(near / f"{process}.sock")) for process in PROCESSES)
        if longest <= SOCKET_PATH_BYTES and re.fullmatch(r"[A-Za-z0-9_./+-]+", str(near)):
            return near
        digest = hashlib.sha256(os.fsencode(home)).hexdigest()[:16]
        return TEMP / f"tenuto-{os.geteuid()}-{digest}"


def write_atomic(path: Path, data: bytes) -> None:
    """Write a file so that, whatever happens, there is the old one or the new one, whole and on the disk.

    Raises:
        OSError: it could not be written; the old one is untouched.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(directory)  # the rename itself
    finally:
        os.close(directory)


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


def _plain(process: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", process):
        raise ValueError(f"process = {process!r}: must be a plain name")
    return process


def _rmdir(path: Path) -> None:
    with suppress(OSError):
        path.rmdir()
