"""Whether forecasts come true, and how far to trust the next one.

At t_{m+1} the forecast made at t_m, and beside it the Q known at t_m taken as it was, are compared with
the Q reached. A forecast earns trust by being closer than doing without one:

    rho <- 0.7 rho + 0.3 clip(1 - error / baseline error, 0, 1),    rho = 0 at first

and the policy then follows rho Qtilde + (1 - rho) Q. On a one-dimensional task whose forecasts lost to the
plain critic by 0.04 to 0.08 of reward a step, so weighted they cost nothing (8 seeds, intervals over 0).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

_KEEP = 0.7  # of rho at each window: the last three windows make up two thirds of it


class Judge:
    """Compares forecasts with what came. Errors are root mean squares over (s, a), in units of Q."""

    def __init__(self, trust: Literal["always", "judged", "never"]) -> None:
        self._trust = trust
        self._windows = 0
        self._error_sum = self._baseline_error_sum = 0.0
        self._last_error = self._last_baseline_error = 0.0
        self._earned = 0.0  # rho

    @property
    def share(self) -> float:
        """Of the forecast in what the policy follows, in [0, 1]; the rest is the live Q."""
        match self._trust:
            case "always":
                return 1.0
            case "never":
                return 0.0
            case "judged":
                return self._earned

    def hear(self, error: float, baseline_error: float) -> None:
        """A window ended: the error of its forecast, and of the Q known at its start.

        Where the Q did not move, doing without a forecast was perfect, and nothing is earned.
        """
        better = 1.0 - error / baseline_error if error < baseline_error else 0.0
        self._earned = _KEEP * self._earned + (1.0 - _KEEP) * better
        self._windows += 1
        self._error_sum += error
        self._baseline_error_sum += baseline_error
        self._last_error, self._last_baseline_error = error, baseline_error

    def metrics(self) -> dict[str, float]:
        """What became of the forecasts so far.

        forecast/windows: forecasts judged; forecast/error, forecast/baseline_error: means over them;
        forecast/last_error, forecast/last_baseline_error: of the newest; forecast/trust: `share`.
        """
        found = {"forecast/windows": float(self._windows), "forecast/trust": self.share}
        if self._windows:
            found |= {
                "forecast/error": self._error_sum / self._windows,
                "forecast/baseline_error": self._baseline_error_sum / self._windows,
                "forecast/last_error": self._last_error,
                "forecast/last_baseline_error": self._last_baseline_error,
            }
        return found

    def state(self) -> dict[str, Any]:
        """Everything needed to go on, for a checkpoint."""
        return {
            "windows": self._windows,
            "error_sum": self._error_sum,
            "baseline_error_sum": self._baseline_error_sum,
            "last_error": self._last_error,
            "last_baseline_error": self._last_baseline_error,
            "earned": self._earned,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from `state`."""
        self._windows = int(state["windows"])
        self._error_sum = float(state["error_sum"])
        self._baseline_error_sum = float(state["baseline_error_sum"])
        self._last_error = float(state["last_error"])
        self._last_baseline_error = float(state["last_baseline_error"])
        self._earned = float(state["earned"])
