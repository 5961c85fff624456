"""The log's lines, and what becomes of them on a disk that takes none."""

from __future__ import annotations

import json
import logging
import resource
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from rtcore.log_files import JsonLines, log_to_file


def lines(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_log_is_json_lines_and_warnings_reach_stderr(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "logs" / "learner.jsonl"
    before_ns = time.monotonic_ns()
    with log_to_file(path, "learner"):
        logging.getLogger("learner.replay").info("took %d steps", 3)
        assert lines(path)[0]["text"] == "took 3 steps"  # written at once
        logging.getLogger("learner").debug("nobody asked")
        logging.getLogger("learner").warning("two\nlines")
    first, second = lines(path)
    assert list(first) == ["ts", "mono_ns", "level", "process", "logger", "text"]
    assert (first["level"], first["process"], first["logger"]) == ("INFO", "learner", "learner.replay")
    assert (second["level"], second["text"]) == ("WARN", "two\nlines")
    assert datetime.fromisoformat(str(first["ts"])).utcoffset() == timedelta(0)
    assert isinstance(first["mono_ns"], int)
    assert before_ns <= first["mono_ns"] <= time.monotonic_ns()
    captured = capsys.readouterr().err
    assert "learner: WARNING: two" in captured
    assert "steps" not in captured


def test_text_that_no_encoding_takes_is_logged_all_the_same() -> None:
    record = logging.LogRecord("x", logging.CRITICAL, "x.py", 1, "file \udcff of %s", ("a",), None)
    line = json.loads(JsonLines("recorder").format(record).encode("ascii"))
    assert (line["text"], line["level"], line["process"]) == ("file \udcff of a", "ERROR", "recorder")


def test_the_log_tells_exceptions_and_is_appended_to(tmp_path: Path) -> None:
    path = tmp_path / "env_server.jsonl"
    for _ in range(2):
        with log_to_file(path, "env_server"):
            try:
                raise KeyError("scale")
            except KeyError:
                logging.getLogger("env_server").exception("env_server failed")
    assert [line["text"] for line in lines(path)] == ["env_server failed"] * 2
    exception = str(lines(path)[0]["exception"])
    assert exception.startswith("Traceback")
    assert exception.endswith("KeyError: 'scale'")


def test_closing_the_log_leaves_logging_as_it_was(tmp_path: Path) -> None:
    root = logging.getLogger()
    before = (root.level, list(root.handlers))
    handle = log_to_file(tmp_path / "x.jsonl", "x", level=logging.DEBUG)
    assert root.level == logging.DEBUG
    handle.close()
    handle.close()
    assert (root.level, root.handlers) == before


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """As on a disk that is full: writing beyond `size` bytes of a file fails."""
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def test_lines_that_a_full_disk_does_not_take_are_counted_where_they_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, logger = tmp_path / "recorder.jsonl", logging.getLogger("recorder")
    with log_to_file(path, "recorder"):
        logger.info("before")
        size = path.stat().st_size
        with files_of_at_most(size + 10):  # half a line has room
            for _ in range(3):
                logger.info("lost")
        logger.info("after")
        logger.info("again")
    assert [line["text"] for line in lines(path)] == [
        "before", "3 log lines were lost before this one", "after", "again",
    ]  # fmt: skip
    assert capsys.readouterr().err.count("log lines are lost") == 1


def test_a_full_disk_that_stderr_lies_on_too_costs_the_complaint_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, logger = tmp_path / "recorder.jsonl", logging.getLogger("recorder")
    with (tmp_path / "recorder.out").open("w", buffering=1) as stderr, log_to_file(path, "recorder"):
        monkeypatch.setattr("sys.stderr", stderr)  # as under a launcher
        with files_of_at_most(0):
            logger.info("lost")
        logger.info("after")
        monkeypatch.undo()
    assert [line["text"] for line in lines(path)] == ["1 log lines were lost before this one", "after"]


def test_a_directory_that_cannot_be_made_costs_the_lines_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "logs").write_text("a file is in the way")
    with log_to_file(tmp_path / "logs" / "agent.jsonl", "agent"):
        logging.getLogger("agent").info("lost")
        logging.getLogger("agent").warning("told on stderr")
    captured = capsys.readouterr().err
    assert captured.count("log lines are lost") == 1
    assert "agent: WARNING: told on stderr" in captured
