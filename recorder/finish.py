"""The end of a recording, orderly or not: compacted, given a footer, checked. Needs no rerun import.

After a crash of everything, or for one that was too long: `python -m recorder.finish RECORDING`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from recorder.frames import join

TIMEOUT_S = 120.0  # measured: 1.3 s for 23 MB in 15 000 chunks, so an hour at 50 Hz stays below 20 s
# Measured: 18 MB/s of a small file; beside others 8 MB/s of 923 MB, for which it took 2.1 GB of memory. What
# cannot be done in time is not begun; whoever asks for it by hand gets the time that it takes.
MOST_BYTES_PER_S, LEAST_BYTES_PER_S = 20e6, 4e6
# What could not be compacted is joined, a plain copy (measured: 0.9 GB/s), by this share of the time more; as
# what was begun is small, half a second will do.
JOIN_SHARE, LEAST_JOIN_S = 0.5, 0.5
# The program itself: `python -m rerun_cli` (0.41) ends with 0 whatever happened and would stand between us
# and it, and `python -m rerun` imports all of rerun.
CLI = (
    "import os, sys, rerun_cli; tool = os.path.join(os.path.dirname(rerun_cli.__file__), 'rerun'); "
    "os.execv(tool, [tool, *sys.argv[2:]])"
)
# Before that, the kernel is asked to kill it when we die (Linux; 1 is PR_SET_PDEATHSIG, and an exec keeps
# it): a kill -9 of the recorder must not leave it writing. Too late if we are gone already.
DIE_WITH_PARENT = (
    "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); "
    "os.getppid() == int(sys.argv[1]) or sys.exit('orphaned'); "
)

MAGIC = b"RRF2"  # begins every recording


class FinishError(RuntimeError):
    """The recording could not be finished; `files_of` says where its rows are."""


class TooSlowError(FinishError):
    """There was not the time for it."""


def parts_of(recording: Path) -> list[Path]:
    """Files that earlier incarnations of the recorder left beside `recording`, oldest first."""
    return sorted(recording.parent.glob(f"{recording.stem}.part*.rrd"))


def files_of(recording: Path) -> list[Path]:
    """Where the rows are: the parts that earlier incarnations left, oldest first, and `recording` itself."""
    return [path for path in [*parts_of(recording), recording] if not _empty(path)]


def set_aside(recording: Path, counts: tuple[int, int] | None = None) -> Path | None:
    """Rename what an earlier incarnation wrote, so that it is not overwritten; None if it wrote nothing.

    Args:
        recording: the file.
        counts: (inode, length) of the part that counts; what that file has beyond is cut off.

    Raises:
        OSError: the disk does not let it.
    """
    _settle(recording)
    if not recording.exists():
        return None
    found = recording.stat()
    length = found.st_size
    if counts is not None and found.st_ino == counts[0] and length > counts[1]:
        length = counts[1]
        os.truncate(recording, length)
    if length == 0:
        return None
    part = recording.with_name(f"{recording.stem}.part{len(parts_of(recording)):03d}.rrd")
    recording.rename(part)
    return part


def finish(recording: Path, *, timeout_s: float = TIMEOUT_S) -> None:
    """Replace `recording` by its compacted, complete and verified form, in one step.

    Takes in the parts of earlier incarnations, and repairs what a kill -9 left behind: a missing footer,
    a torn last chunk. If that fails, it still makes one file of them if it can, as a kill -9 leaves it:
    readable, not compact, not checked. Killed itself, at any instant, it can be called again.

    Args:
        recording: the file.
        timeout_s: for all of it; making one file at least may take half as long again.

    Raises:
        TooSlowError: there was not the time.
        FinishError: it did not work. Either way no row is lost, nor there twice.
    """
    workshop = recording.with_name(f".{recording.stem}.finishing-{os.getpid()}")
    working = workshop / recording.name
    due_s = time.monotonic() + timeout_s * (1 + JOIN_SHARE)
    try:
        _clear(recording)
        _settle(recording)
        sources = [_checked(path) for path in files_of(recording)]
        if not sources:
            raise FinishError(f"{recording.name}: nothing was written")
        workshop.mkdir()
        try:
            _compact(sources, working, timeout_s)
        except (FinishError, OSError):
            if len(sources) > 1:
                _join(sources, working, max(due_s, time.monotonic() + LEAST_JOIN_S))
                working.rename(_finished(recording))
                _settle(recording)
            raise
        working.rename(_finished(recording))
        _settle(recording)
    except (OSError, ValueError) as error:
        raise FinishError(f"{recording.name}: {error}") from error
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def _compact(sources: Sequence[Path], working: Path, timeout_s: float) -> None:
    """Make `working` of the sources, and check it, all in so much time."""
    size = _size(sources)
    if size > timeout_s * MOST_BYTES_PER_S:
        raise TooSlowError(f"{size / 1e6:,.0f} MB take over {timeout_s:.2g} s")
    due_s = time.monotonic() + timeout_s
    optimise = ["rrd", "optimize", *map(str, sources), "-o", str(working)]
    run_cli(optimise, timeout_s=timeout_s, home_in=working.parent)
    rest_s = max(0.0, due_s - time.monotonic())
    run_cli(["rrd", "verify", str(working)], timeout_s=rest_s, home_in=working.parent)


def _join(sources: Sequence[Path], working: Path, due_s: float) -> None:
    """Make `working` of the sources as they are."""
    try:
        join(sources, working, due_s)
    except TimeoutError as error:
        raise TooSlowError(f"there was not even the time to join {_size(sources) / 1e6:,.0f} MB") from error


def _size(sources: Sequence[Path]) -> int:
    return sum(source.stat().st_size for source in sources)


def _clear(recording: Path) -> None:
    """Remove what those left who were killed while they finished it."""
    for workshop in recording.parent.glob(f".{recording.stem}.finishing-*"):
        pid = int(workshop.name.rpartition("-")[2])
        if pid == os.getpid() or not _alive(pid):
            shutil.rmtree(workshop, ignore_errors=True)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # somebody else's
        pass
    return True


def _finished(recording: Path) -> Path:
    return recording.with_name(f".{recording.stem}.finished.rrd")


def _settle(recording: Path) -> None:
    """From the moment at which the finished file has its name, it stands for the parts and the recording:
    remove them, and put it in their place. Does nothing where there is none.
    """
    finished = _finished(recording)
    if finished.exists():
        for part in parts_of(recording):
            part.unlink()
        finished.replace(recording)


def _empty(path: Path) -> bool:
    return not path.exists() or path.stat().st_size == 0


def _checked(path: Path) -> Path:
    """Raise FinishError for what is no recording: rerun would take it for an empty one (0.41)."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise FinishError(f"{path.name} is no recording")
    return path


def run_cli(arguments: Sequence[str], *, timeout_s: float, home_in: Path | None = None) -> str:
    """Run rerun's command line, with nothing inherited and its usage statistics switched off.

    It reads that switch from the user's configuration directory alone, so it gets a home directory of
    its own for the moment, and the user's is not touched. A Ctrl-C in the terminal does not reach it. It dies
    with the thread that calls this.

    Args:
        arguments: of the command line.
        timeout_s: it has so long.
        home_in: where its home is made; None: where the system keeps such things.

    Returns:
        What it printed.

    Raises:
        TooSlowError: it took longer than `timeout_s`.
        FinishError: it failed.
    """
    where = None if home_in is None else home_in.absolute()
    with tempfile.TemporaryDirectory(prefix="tenuto-", dir=where) as home:
        switch_off_statistics(Path(home))
        code, text = _ran(arguments, timeout_s, home)
    if code != 0:
        last = text.splitlines()[-1] if text else "no output"
        raise FinishError(f"rerun {' '.join(arguments[:2])} failed ({code}): {last}")
    return text


def _ran(arguments: Sequence[str], timeout_s: float, home: str) -> tuple[int, str]:
    """Run rerun's command line with this home: its exit code, and what it printed."""
    with subprocess.Popen(
        [sys.executable, "-c", DIE_WITH_PARENT + CLI, str(os.getpid()), *arguments],
        env={"HOME": home, "NO_COLOR": "1", "RUST_LOG": "warn"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        process_group=0,
    ) as child:
        try:
            output, _ = child.communicate(timeout=timeout_s)
        except BaseException as error:
            child.kill()
            if isinstance(error, subprocess.TimeoutExpired):
                what = f"rerun {' '.join(arguments[:2])} took over {timeout_s:.2g} s"
                raise TooSlowError(what) from error
            raise
    return child.returncode, output.decode(errors="replace").strip()


def switch_off_statistics(home: Path) -> None:
    """Write below `home` what `rerun analytics disable` would: all fields, or rerun 0.41 ignores it."""
    path = home / ".config" / "rerun" / "analytics.json"
    path.parent.mkdir(parents=True)
    settings = {
        "analytics_enabled": False,
        "analytics_id": "",
        "metadata": {},
        "config_file_path": str(path),
        "data_dir_path": str(home / "analytics"),
    }
    path.write_text(json.dumps(settings))


def main(argv: Sequence[str] | None = None) -> int:
    """Finish a recording; 1 if that fails."""
    parser = argparse.ArgumentParser(prog="python -m recorder.finish", description="Repair a recording.")
    parser.add_argument("recording", type=Path)
    parser.add_argument(
        "--within-s", type=float, metavar="S", help="compact it only if that takes no longer; else join it"
    )
    given = parser.parse_args(argv)
    recording, within_s = given.recording, given.within_s
    if within_s is None:
        within_s = max(TIMEOUT_S, _size(files_of(recording)) / LEAST_BYTES_PER_S)
    try:
        finish(recording, timeout_s=within_s)
    except FinishError as error:
        files = len(files_of(recording))
        sys.stderr.write(f"{error}; it is in {files} files\n" if files > 1 else f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
