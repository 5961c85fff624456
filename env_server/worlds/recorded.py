"""A drift that was recorded: a CSV file with the columns `unit` and `value`."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

COLUMNS = ("unit", "value")


def read_series(path: str) -> tuple[list[float], list[float]]:
    """The rows of the file, in order; other columns are ignored.

    Returns:
        Units, strictly rising, and a value for each; at least one row, all finite.

    Raises:
        ValueError: says in one line what is wrong with the file.
    """
    if not path:
        raise ValueError(f"must be a CSV file with the columns {' and '.join(COLUMNS)}")
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            found = set(rows.fieldnames or ())
            if missing := [name for name in COLUMNS if name not in found]:
                raise ValueError(f"must have a column {missing[0]!r} in its first line")
            return _rising([(rows.line_num, *_numbers(row, rows.line_num)) for row in rows])
    except OSError as error:
        raise ValueError(f"must be a readable file ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"must be a CSV file ({error})") from error


def _numbers(row: dict[str, str | None], line: int) -> tuple[float, float]:
    unit, value = (_number(row[name], name, line) for name in COLUMNS)
    return unit, value


def _number(text: str | None, name: str, line: int) -> float:
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"line {line}: {name} must be a finite number, not {text or ''!r}")
    return number


def _rising(rows: list[tuple[int, float, float]]) -> tuple[list[float], list[float]]:
    if not rows:
        raise ValueError("must have at least one row below its first line")
    for (_, before, _), (line, unit, _) in pairwise(rows):
        if unit <= before:
            raise ValueError(f"line {line}: units must rise, but {unit:g} follows {before:g}")
    return [unit for _, unit, _ in rows], [value for _, _, value in rows]
