"""What a measurement was made on."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from launcher.machine import machine


def facts(packages: Sequence[str] = ()) -> dict[str, Any]:
    """The machine, the versions of `packages`, and the load (the measurement's own included)."""
    return {
        **machine(),
        "load_1_min": os.getloadavg()[0],
        "versions": {package: version(package) for package in packages},
    }
