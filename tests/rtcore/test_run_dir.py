from __future__ import annotations

import os
import stat
import threading
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
from msgspec.structs import replace

from rtcore import run_dir
from rtcore.config import ConfigError, EnvConfig, RunConfig
from rtcore.config_io import dump_toml, load_toml
from rtcore.files import write_atomic
from rtcore.messages import Stats
from rtcore.run_dir import RunDir, default_run_path, latest
from rtcore.tally import Tally

CONFIG = RunConfig(preset="pointmass", seed=4, env=EnvConfig(id="pointmass", hz=100.0))


def below(path: Path) -> set[str]:
    return {str(found.relative_to(path)) for found in path.rglob("*")}


def test_create_makes_all_that_a_run_needs(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path / "runs" / "one", CONFIG)
    assert below(tmp_path / "runs") == {"one", "one/run.toml", "one/learner", "one/logs"}
    assert load_toml(run.config_path) == CONFIG == run.config() == RunDir.open(run.path).config()


def test_where_things_lie() -> None:
    run = RunDir(Path("/runs/one"))
    assert run.run_name == "one"
    assert run.recording_path == Path("/runs/one/recording.rrd")
    assert run.summary_path == Path("/runs/one/summary.json")
    assert run.learner_dir == Path("/runs/one/learner")
    assert run.world_path == Path("/runs/one/world.mjb")
    assert run.log_path("learner") == Path("/runs/one/logs/learner.jsonl")
    assert run.stats_path("learner", 17) == Path("/runs/one/logs/learner-17.stats")
    for odd in ("../learner", "", "a/b", "a\0"):
        with pytest.raises(ValueError, match="must be a plain name"):
            run.log_path(odd)


def test_a_relative_path_is_kept_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = RunDir.create(Path("sub/../here"), CONFIG)
    assert run.path == tmp_path / "here" and run.run_name == "here"
    monkeypatch.chdir("/")
    assert run.config() == CONFIG


def test_a_run_name_fits_into_a_key() -> None:
    assert RunDir(Path("/runs/my run #1*$?")).run_name == "my_run__1___"
    assert RunDir(Path("/")).run_name == "run"


def test_what_exists_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "one"
    RunDir.create(path, CONFIG)
    before = below(tmp_path)
    with pytest.raises(ConfigError) as error:
        RunDir.create(path, RunConfig())
    assert str(error.value) == f"run_dir = {str(path)!r}: must not exist yet"
    assert below(tmp_path) == before and RunDir.open(path).config() == CONFIG
    dangling = tmp_path / "dangling"
    dangling.symlink_to("nowhere")
    with pytest.raises(ConfigError, match="must not exist yet"):
        RunDir.create(dangling, CONFIG)


def test_a_wrong_configuration_makes_nothing(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^env\.count = 0: must be an integer in 1\.\.16$"):
        RunDir.create(tmp_path / "a" / "b", RunConfig(env=EnvConfig(count=0)))
    assert below(tmp_path) == set()


def test_a_path_that_cannot_be_made_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    cases = {
        tmp_path / "file" / "run": "Not a directory",
        tmp_path / "new" / "deep" / ("x" * 300): "File name too long",  # its parents are made first
        tmp_path / "nul\0": "null byte",
        Path("/proc/tenuto/run"): "No such file or directory",
    }
    for path, reason in cases.items():
        with pytest.raises(
            ConfigError, match=rf"^run_dir = .*: must be a path to write to \(.*{reason}.*\)$"
        ):
            RunDir.create(path, CONFIG)
        assert below(tmp_path) == {"file"}


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_half_way_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    def fail(path: Path, data: bytes) -> None:
        path.write_bytes(data[:10])
        raise failure

    monkeypatch.setattr(run_dir, "write_atomic", fail)
    with pytest.raises((ConfigError, KeyboardInterrupt), match=r"No space left|^$"):
        RunDir.create(tmp_path / "runs" / "one", CONFIG)
    assert below(tmp_path) == set()


def test_open_wants_a_run(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(ConfigError) as error:
            RunDir.open(path)
        assert str(error.value) == f"run_dir = {str(path)!r}: must be a run's directory, with run.toml in it"


def test_an_edited_configuration_is_checked(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path / "one", CONFIG)
    run.config_path.write_text(dump_toml(CONFIG).replace("hz = 100.0", "hz = -100.0"))
    with pytest.raises(ConfigError, match=r"^env\.hz = -100\.0: "):
        run.config()


def test_a_failed_start_is_taken_back(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path / "runs" / "deep" / "one", CONFIG)
    assert run.remove_if_empty()
    assert below(tmp_path) == set()


def test_parents_in_use_stay(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path / "runs" / "deep" / "one", CONFIG)
    RunDir.create(tmp_path / "runs" / "two", CONFIG)
    assert run.remove_if_empty()
    assert {str(path) for path in (tmp_path / "runs").iterdir()} == {str(tmp_path / "runs" / "two")}


@pytest.mark.parametrize("written", ["logs/learner.jsonl", "learner/replay", "summary.json"])
def test_a_run_that_wrote_something_stays(tmp_path: Path, written: str) -> None:
    run = RunDir.create(tmp_path / "one", CONFIG)
    (run.path / written).touch()
    before = below(tmp_path)
    assert not run.remove_if_empty()
    assert below(tmp_path) == before


def test_only_what_create_made_is_removed(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    RunDir.create(tmp_path / "runs" / "one", CONFIG)
    assert RunDir.open(tmp_path / "runs" / "one").remove_if_empty()
    assert below(tmp_path) == {"runs"}


def stats(process: str, incarnation: int, ticks: int) -> Stats:
    return Stats(
        process=process,
        incarnation=incarnation,
        seq=1,
        at_ns=2,
        final=True,
        counters={"ticks": ticks},
        gauges={"loss/critic": 0.5},
        histograms={"loop": b"\x00\x01"},
    )


def test_final_stats_of_every_life_are_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = RunDir.create(tmp_path / "one", CONFIG)
    assert run.read_final_stats() == []
    lives = [stats("env_server", 9, 1), stats("env_server", 10, 2), stats("learner", 1, 3)]
    for life in reversed(lives):
        run.write_final_stats(life)
    run.write_final_stats(lives[0])  # a second time replaces the first
    assert run.read_final_stats() == lives
    assert caplog.text == ""
    run.stats_path("recorder", 1).write_bytes(b"\x93torn")
    assert run.read_final_stats() == lives
    assert "recorder-1.stats left out of the summary" in caplog.text


def test_atomic_writes_replace_whole_files(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomic(path, b"one")
    write_atomic(path, b"two")
    assert path.read_bytes() == b"two"
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask
    assert below(tmp_path) == {"file"}


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "file").mkdir()
    with pytest.raises(IsADirectoryError):
        write_atomic(tmp_path / "file", b"new")
    with pytest.raises(FileNotFoundError):
        write_atomic(tmp_path / "none" / "file", b"new")
    assert below(tmp_path) == {"file"}


def test_writers_at_once_never_mix(tmp_path: Path) -> None:
    path = tmp_path / "file"
    texts = [bytes([65 + number]) * 200_000 for number in range(4)]
    threads = [threading.Thread(target=write_atomic, args=(path, text)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_bytes() in texts
    assert below(tmp_path) == {"file"}


def test_the_default_path_is_in_utc() -> None:
    instant = datetime(2026, 1, 31, 23, 59, 58, tzinfo=UTC)
    expected = Path("runs/20260131T235958Z-halfcheetah")
    assert default_run_path(Path("runs"), "halfcheetah", instant) == expected
    elsewhere = instant.astimezone(timezone(timedelta(hours=5, minutes=30)))
    assert default_run_path(Path("runs"), "halfcheetah", elsewhere) == expected


def test_latest_is_the_run_made_last(tmp_path: Path) -> None:
    assert latest(tmp_path / "none") is None
    assert latest(tmp_path) is None
    for age, name in enumerate(("a", "z", "m")):
        run = RunDir.create(tmp_path / name, CONFIG)
        os.utime(run.config_path, ns=(0, 10**18 - age * 10**9))
    (tmp_path / "y").mkdir()  # not a run
    (tmp_path / "run.toml").touch()
    newest = latest(tmp_path)
    assert newest is not None and newest.path == tmp_path / "a"
    os.utime(tmp_path / "z" / "run.toml", ns=(0, 10**18))
    tied = latest(tmp_path)
    assert tied is not None and tied.path == tmp_path / "z"


def test_a_tally_raises_the_last_words_and_stands_for_those_that_were_never_said(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path / "one", CONFIG)
    for incarnation in (9, 10):
        with Tally.create(run.tally_path("env_server", incarnation)) as tally:
            tally.set_together({"ticks": 5, "resets": 1})
    run.write_final_stats(stats("env_server", 9, 7))
    last, killed = run.read_final_stats()
    assert last == replace(stats("env_server", 9, 7), counters={"ticks": 7, "resets": 1})
    assert (killed.process, killed.incarnation, killed.final) == ("env_server", 10, False)
    assert killed.counters == {"ticks": 5, "resets": 1}
    run.tally_path("recorder", 1).write_bytes(b"torn")
    assert [one.counters for one in run.read_final_stats()][2:] == [{}]


def test_processes_of_a_fleet_have_files_of_their_own(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path / "one", CONFIG)
    for process, ticks in (("env_server.0", 3), ("env_server.1", 4), ("env_server", 5)):
        with Tally.create(run.tally_path(process, 9)) as tally:
            tally.set_together({"ticks": ticks})
    found = {one.process: one.counters for one in run.read_final_stats()}
    assert found == {"env_server.0": {"ticks": 3}, "env_server.1": {"ticks": 4}, "env_server": {"ticks": 5}}
    assert run.next_incarnation("env_server.1", 5) == 10
    assert run.next_incarnation("env_server.2", 5) == 5
    names = [path.name for path in (run.log_path("agent_service.2"), run.lives_path("env_server.2"))]
    assert names == ["agent_service.2.jsonl", "epoch.2.json"]
    assert run.lives_path("env_server") == run.epoch_path
    assert run.adopted_path("agent_service.2").name == "policy.2.msgpack"
    assert run.adopted_path("agent_service").name == "policy.msgpack"
    for name in ("env_server.", "env_server.x", "..", "a/b.1"):
        with pytest.raises(ValueError, match="must be a plain name"):
            run.log_path(name)


def test_an_incarnation_is_greater_than_all_before_it(tmp_path: Path) -> None:
    run = RunDir.create(tmp_path / "one", CONFIG)
    assert run.next_incarnation("learner", 500) == 500
    run.write_final_stats(stats("learner", 700, 1))
    run.tally_path("learner", 710).touch()
    run.tally_path("recorder", 900).touch()
    (run.logs_dir / "learner-x.tally").touch()
    assert run.next_incarnation("learner", 500) == 711  # the host's clock was set back
    assert run.next_incarnation("learner", 800) == 800
