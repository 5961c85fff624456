"""`tenuto` as people run it: a real process, somewhere else than in the repository."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def command_line(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "launcher", *arguments]


def tenuto(*arguments: str, cwd: Path, timeout_s: float = 30.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command_line(*arguments), cwd=cwd, capture_output=True, text=True, timeout=timeout_s, check=False
    )


def tree(path: Path) -> set[Path]:
    return set(path.rglob("*"))
