"""What a measurement was made on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")


def machine() -> dict[str, str | int]:
    """Processor, cores, kernel and the versions that matter for latency."""
    return {
        "processor": processor(CPUINFO.read_text() if CPUINFO.exists() else ""),
        "cores": os.cpu_count() or 1,
        "kernel": platform.release(),
        "python": platform.python_version(),
        "zenoh": version("eclipse-zenoh"),
        "tenuto": version("tenuto"),
    }


def processor(cpuinfo: str) -> str:
    """The first model name in the text of /proc/cpuinfo, or what else is known of the processor."""
    for line in cpuinfo.splitlines():
        name, _, value = line.partition(":")
        if name.strip() == "model name":
            return " ".join(value.split())
    return platform.machine()
