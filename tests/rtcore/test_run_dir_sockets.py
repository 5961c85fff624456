from __future__ import annotations

import os
import shutil
import socket
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtcore.channels import PROCESSES
from rtcore.config import ConfigError, RunConfig
from rtcore.run_dir import RunDir

CONFIG = RunConfig()


@pytest.fixture
def short() -> Iterator[Path]:
    """A directory with a path short enough for sockets, whatever TMPDIR is."""
    with tempfile.TemporaryDirectory(prefix="t-", dir="/tmp") as name:
        yield Path(name).resolve()


def test_sockets_lie_in_the_run_where_they_fit(short: Path) -> None:
    # short + "/" + name + "/link/agent_service.sock" comes to exactly 100 bytes, then to one more
    fits = "x" * (100 - len(str(short)) - 1 - len("/link/agent_service.sock"))
    run = RunDir.create(short / fits, CONFIG)
    assert run.socket_dir() == short / fits / "link"
    assert stat.S_IMODE(run.socket_dir().stat().st_mode) == 0o700
    assert max(len(str(run.socket_dir() / f"{process}.sock")) for process in PROCESSES) == 100
    longer = RunDir.create(short / (fits + "x"), CONFIG)
    try:
        assert longer.socket_dir().parent == Path("/tmp")
    finally:
        longer.remove_socket_dir()


@pytest.fixture
def far(tmp_path: Path) -> Iterator[RunDir]:
    """A run whose own path is too long for sockets."""
    run = RunDir.create(tmp_path / ("y" * 100), CONFIG)
    yield run
    run.remove_socket_dir()


def test_a_far_socket_directory_is_short_private_and_found_again(far: RunDir, tmp_path: Path) -> None:
    directory = far.socket_dir()
    assert directory.name.startswith(f"tenuto-{os.geteuid()}-") and len(str(directory)) < 60
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    link = tmp_path / "short"
    link.symlink_to(far.path)
    assert RunDir.open(link).socket_dir() == RunDir.open(far.path).socket_dir() == directory
    other = RunDir.create(tmp_path / ("z" * 100), CONFIG)
    try:
        assert other.socket_dir() != directory
    finally:
        other.remove_socket_dir()


def test_a_socket_really_fits(far: RunDir, short: Path) -> None:
    for run in (far, RunDir.create(short / "one", CONFIG)):
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(run.socket_dir() / "agent_service.sock"))


@pytest.mark.parametrize("name", ["a#b", "a;b", "a?b", "a b", "a%b", "ä"])
def test_signs_that_mean_something_in_an_endpoint_keep_sockets_away(tmp_path: Path, name: str) -> None:
    run = RunDir.create(tmp_path / name, CONFIG)
    try:
        assert run.socket_dir().parent == Path("/tmp")
    finally:
        run.remove_socket_dir()


def test_a_socket_directory_that_others_can_reach_is_refused(short: Path) -> None:
    run = RunDir.create(short / "one", CONFIG)
    allowed = f"must be a directory of user {os.geteuid()} with mode 0700"
    directory = run.socket_dir()
    for mode in (0o755, 0o710, 0o701):
        directory.chmod(mode)
        with pytest.raises(ConfigError, match=allowed):
            run.socket_dir()
    run.remove_socket_dir()
    (short / "elsewhere").mkdir(mode=0o700)
    (run.path / "link").symlink_to(short / "elsewhere")
    with pytest.raises(ConfigError, match=allowed):
        run.socket_dir()
    (run.path / "link").unlink()
    (run.path / "link").touch(mode=0o600)
    with pytest.raises(ConfigError, match=allowed):
        run.socket_dir()


def test_a_socket_directory_needs_its_run(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^run_dir\.socket_dir = .* \(No such file or directory\)$"):
        RunDir(tmp_path / "none").socket_dir()


def test_stale_sockets_go_and_strangers_stay(far: RunDir) -> None:
    directory = far.socket_dir()
    (directory / "learner.sock").touch()
    (directory / "learner.sock.lock").touch()
    (directory / "agent_service.12.sock").touch()
    (directory / "agent_service.12.sock.lock").touch()
    (directory / "stranger").touch()
    far.remove_socket_dir()
    assert [path.name for path in directory.iterdir()] == ["stranger"]
    (directory / "stranger").unlink()
    far.remove_socket_dir()
    assert not directory.exists()
    far.remove_socket_dir()


def test_what_an_earlier_run_at_the_same_path_left_is_gone(far: RunDir) -> None:
    directory = far.socket_dir()
    for name in ("ports.json", "env_server.sock"):
        (directory / name).touch()
    shutil.rmtree(far.path)  # by hand, after it crashed
    again = RunDir.create(far.path, CONFIG)
    assert again.socket_dir() == directory and list(directory.iterdir()) == []


@pytest.mark.parametrize("name", ["one", "x" * 100])
def test_a_failed_start_takes_its_socket_directory_back(short: Path, name: str) -> None:
    run = RunDir.create(short / "runs" / "deep" / name, CONFIG)
    sockets = run.socket_dir()
    assert run.remove_if_empty()
    assert not sockets.exists() and list(short.iterdir()) == []
