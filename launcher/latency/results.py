"""What `tenuto latency` measured, and how it becomes `latency.json`. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from launcher.echo.links import Transport
from launcher.echo.measure import EchoResult
from launcher.latency.hold_rate import Search, statement
from launcher.latency.trial import Load, Quantity, Trial
from launcher.quantiles import SHARES, Quantiles

SCHEMA = 1
SETTLED_S = 1.0  # the first second has the page faults, the cold caches and the first connections
LABELS: dict[Quantity, str] = {"pacing": "pacing_error_us", "loop": "loop_us", "reaction": "reaction_us"}


@dataclass
class Cell:
    """One rate under one load: the system, and the bare echoes of the same minute.

    An echo is absent until it was measured.
    """

    hz: float
    load: Load
    system: Trial
    echoes: dict[Transport, EchoResult] = field(default_factory=dict)

    def ratio(self, transport: Transport, after_s: float = 0.0) -> Quantiles:
        """The system's loop over the echo's round trip, at each quantile; None where one is missing."""
        if transport not in self.echoes:
            return dict.fromkeys(SHARES)
        loop = self.system.quantiles_us("loop", after_s)
        echo = self.echoes[transport].latency_us(after_s)
        return {name: _over(loop[name], echo[name]) for name in SHARES}


@dataclass
class Results:
    """Everything so far.

    Attributes:
        at: when it began, UTC, ISO 8601.
        machine: what it was measured on.
        options: as asked for.
        cells: by rate and load, in order.
        search: of `--hold-rate`.
        interrupted: somebody ended it before its time.
    """

    at: str
    machine: Mapping[str, Any]
    options: Mapping[str, Any]
    cells: list[Cell] = field(default_factory=list)
    search: Search | None = None
    interrupted: bool = False


def as_json(results: Results) -> dict[str, Any]:
    """The content of `latency.json`. Durations are in microseconds where the name says so."""
    found: dict[str, Any] = {
        "schema": SCHEMA,
        "at": results.at,
        "machine": dict(results.machine),
        "options": dict(results.options),
        "interrupted": results.interrupted,
        "cells": [_cell(cell) for cell in results.cells],
    }
    if results.search is not None:
        search = results.search
        found["hold_rate"] = {
            "limit": search.limit,
            "confidence": search.confidence,
            "established_hz": search.established_hz,
            "ended": search.ended,
            "attempts": [asdict(attempt) for attempt in search.attempts],
            "statement": statement(search),
        }
    return found


def _cell(cell: Cell) -> dict[str, Any]:
    return {
        "hz": cell.hz,
        "load": cell.load,
        "system": _system(cell.system),
        "echo": {transport: _echo(echo) for transport, echo in cell.echoes.items()},
        "loop_over_echo": {transport: _rounded(cell.ratio(transport), 3) for transport in cell.echoes},
        "loop_over_echo_settled": {
            transport: _rounded(cell.ratio(transport, SETTLED_S), 3) for transport in cell.echoes
        },
    }


def _system(trial: Trial) -> dict[str, Any]:
    settled_ticks, settled_missed = trial.since(SETTLED_S)
    return {
        "ticks": trial.ticks,
        "missed": trial.missed,
        "miss_ratio": trial.miss_ratio,
        "missed_by_cause": trial.causes,
        "overruns": trial.overruns,
        "skipped": trial.skipped,
        **_durations(trial, 0.0),
        "settled": {
            "after_s": SETTLED_S,
            "ticks": settled_ticks,
            "missed": settled_missed,
            **_durations(trial, SETTLED_S),
        },
        "updates_per_s": trial.updates_per_s,
        "placement": trial.placement,
        "steal_s": trial.steal_s,
        "span_s": round(trial.span_s, 3),
        "unseen_ticks": trial.unseen,
        "interrupted": trial.interrupted,
    }


def _durations(trial: Trial, after_s: float) -> dict[str, Quantiles]:
    return {label: _rounded(trial.quantiles_us(name, after_s)) for name, label in LABELS.items()}


def _echo(echo: EchoResult) -> dict[str, Any]:
    return {
        "ticks": echo.ticks,
        "missed": echo.missed,
        "miss_ratio": echo.miss_ratio,
        "overruns": echo.overruns,
        "skipped": echo.skipped,
        "pacing_error_us": _rounded(echo.pacing_us()),
        "round_trip_us": _rounded(echo.latency_us()),
        "settled": {
            "after_s": SETTLED_S,
            "pacing_error_us": _rounded(echo.pacing_us(SETTLED_S)),
            "round_trip_us": _rounded(echo.latency_us(SETTLED_S)),
        },
        "placement": echo.placement,
        "steal_s": echo.steal_s,
        "span_s": round(echo.span_s, 3),
    }


def _over(ours: float | None, theirs: float | None) -> float | None:
    return None if ours is None or not theirs else ours / theirs


def _rounded(values: Quantiles, digits: int = 1) -> Quantiles:
    return {name: None if value is None else round(value, digits) for name, value in values.items()}
