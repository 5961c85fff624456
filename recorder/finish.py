"""The end of a recording, orderly or not: compacted, given a footer, checked. Needs no rerun import.

After a crash of everything: `python -m recorder.finish RECORDING`.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

TIMEOUT_S = 120.0  # measured: 1.3 s for 23 MB in 15 000 chunks, so an hour at 50 Hz stays below 20 s
# `python -m rerun_cli` (0.41) ends with 0 whatever happened, and `python -m rerun` imports all of rerun.
CLI = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"

MAGIC = b"RRF2"  # begins every recording


class FinishError(RuntimeError):
    """The recording could not be finished; the file is as it was."""


def parts_of(recording: Path) -> list[Path]:
    """Files that earlier incarnations of the recorder left beside `recording`, oldest first."""
    return sorted(recording.parent.glob(f"{recording.stem}.part*.rrd"))


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
    a torn last chunk. Killed itself, at any instant, it can be called again.

    Raises:
        FinishError: it did not work; no row is lost, nor there twice.
    """
    working = recording.with_name(f".{recording.stem}.finishing.rrd")
    try:
        _settle(recording)
        sources = [_checked(path) for path in [*parts_of(recording), recording] if not _empty(path)]
        if not sources:
            raise FinishError(f"{recording.name}: nothing was written")
        run_cli(["rrd", "optimize", *map(str, sources), "-o", str(working)], timeout_s=timeout_s)
        run_cli(["rrd", "verify", str(working)], timeout_s=timeout_s)
        working.rename(_finished(recording))
        _settle(recording)
    except OSError as error:
        raise FinishError(f"{recording.name}: {error}") from error
    finally:
        with suppress(OSError):
            working.unlink(missing_ok=True)


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


def run_cli(arguments: Sequence[str], *, timeout_s: float) -> str:
    """Run rerun's command line, with nothing inherited and its usage statistics switched off.

    It reads that switch from the user's configuration directory alone, so it gets a home directory of
    its own for the moment, and the user's is not touched. A Ctrl-C in the terminal does not reach it.

    Returns:
        What it printed.

    Raises:
        FinishError: it failed, or took longer than `timeout_s`.
    """
    with tempfile.TemporaryDirectory(prefix="tenuto-") as home:
        switch_off_statistics(Path(home))
        command = [sys.executable, "-c", CLI, *arguments]
        with subprocess.Popen(
            command,
            env={"HOME": home, "NO_COLOR": "1", "RUST_LOG": "warn"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            process_group=0,
        ) as child:
            try:
                output, _ = child.communicate(timeout=timeout_s)
            except BaseException as error:
                os.killpg(child.pid, signal.SIGKILL)  # the Python wrapper and the program behind it
                if isinstance(error, subprocess.TimeoutExpired):
                    raise FinishError(f"rerun {' '.join(arguments[:2])} took over {timeout_s:g} s") from error
                raise
    text = output.decode(errors="replace").strip()
    if child.returncode != 0:
        last = text.splitlines()[-1] if text else "no output"
        raise FinishError(f"rerun {' '.join(arguments[:2])} failed ({child.returncode}): {last}")
    return text


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
    try:
        finish(parser.parse_args(argv).recording)
    except FinishError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
