"""`tenuto ...`, also as `python -m launcher ...`."""

from __future__ import annotations

import sys

from launcher.cli import run_command


def main() -> None:
    """Run one command and exit with its code."""
    sys.exit(run_command(sys.argv[1:]))


if __name__ == "__main__":
    main()
