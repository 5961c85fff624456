"""Every kind of drift against numbers worked out by hand, and every file that is none."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from env_server.worlds.drift import DRIFT_STREAM, FRICTION, MASS, TARGET, Drift, make_drift
from env_server.worlds.registry import resolve
from rtcore.config import ConfigError, DriftConfig, DriftKind, EnvConfig, PhysicsConfig

SEED = 5


def values(units: Any, **fields: Any) -> list[float]:
    drift = make_drift(DriftConfig(**fields), SEED)
    return [drift.value(t) for t in units]


def normals(number: int, stream: int = TARGET, seed: int = SEED) -> list[float]:
    """n_0, n_1, ... as the module promises to draw them."""
    rng = np.random.default_rng([seed, DRIFT_STREAM, stream, 2])
    return [float(n) for n in rng.standard_normal(number)]


def test_none_is_zero_whatever_the_numbers() -> None:
    assert values((0, 1, 7), kind="none", offset=3.0, amplitude=2.0, omega=1.0, low=5.0) == [0.0] * 3


def test_constant_stays() -> None:
    assert values((0, 1, 7), kind="constant", offset=1.5, amplitude=2.0, omega=1.0) == [1.5] * 3


def test_sine_by_hand() -> None:
    # a quarter turn per unit: offset, offset + a, offset, offset - a, offset
    found = values(range(5), kind="sine", offset=1.0, amplitude=0.5, omega=math.pi / 2)
    assert found == pytest.approx([1.0, 1.5, 1.0, 0.5, 1.0])


def test_sine_with_phase_by_hand() -> None:
    # sin(pi / 6) = 1/2, sin(pi / 6 + pi / 3) = 1
    found = values((0, 1), kind="sine", amplitude=2.0, omega=math.pi / 3, phase=math.pi / 6)
    assert found == pytest.approx([1.0, 2.0])


def test_the_authors_values() -> None:
    # 1.0 + 0.2 sin(0.001 * 500) = 1 + 0.2 * 0.479425538604203
    found = values([500], kind="sine", offset=1.0, amplitude=0.2, omega=0.001)
    assert found == pytest.approx([1.0958851077208406], rel=1e-12)


def test_square_by_hand() -> None:
    # sin(pi t / 2) = 0, 1, 0, -1, 0: the zeros count as positive, also where floats make them -1e-16
    assert values(range(5), kind="square", offset=1.0, amplitude=0.5, omega=math.pi / 2) == [
        1.5, 1.5, 1.5, 0.5, 1.5,
    ]  # fmt: skip
    # omega = pi: every unit is a zero, however far
    units = [0, 1, 2, 3, 1_000_000, 1_000_001]
    assert values(units, kind="square", amplitude=1.0, omega=math.pi) == [1.0] * 6
    # phase pi / 2: cos(pi t / 2) = 1, 0, -1, 0
    found = values(range(4), kind="square", amplitude=2.0, omega=math.pi / 2, phase=math.pi / 2)
    assert found == [2.0, 2.0, -2.0, 2.0]


def test_ramp_by_hand() -> None:
    # begins in unit 2 and takes 4: shares 0, 0, 0, 1/4, 2/4, 3/4, 1, 1 of an amplitude of -2 from 1
    assert values(range(8), kind="ramp", offset=1.0, amplitude=-2.0, at=2, span=4) == [
        1.0, 1.0, 1.0, 0.5, 0.0, -0.5, -1.0, -1.0,
    ]  # fmt: skip


def test_switch_by_hand() -> None:
    assert values(range(6), kind="switch", offset=1.0, amplitude=2.0, at=3) == [1, 1, 1, 3, 3, 3]
    # back and forth each 2 units from unit 1 on
    assert values(range(8), kind="switch", amplitude=2.0, at=1, every=2) == [0, 2, 2, 0, 0, 2, 2, 0]
    # between two units: the first whole unit after it
    assert values(range(4), kind="switch", amplitude=1.0, at=1.5) == [0, 0, 1, 1]


def test_burst_by_hand() -> None:
    assert values(range(7), kind="burst", offset=1.0, amplitude=2.0, at=2, span=3) == [1, 1, 3, 3, 3, 1, 1]
    # 2 units on of each 5, from unit 1 on
    found = values(range(13), kind="burst", amplitude=1.0, at=1, span=2, every=5)
    assert found == [0, 1, 1, 0, 0, 0, 1, 1, 0, 0, 0, 1, 1]


def test_random_walk_by_hand() -> None:
    n = normals(3)
    expected = [2.0, 2.0 + 0.5 * n[0], 2.0 + 0.5 * (n[0] + n[1]), 2.0 + 0.5 * (n[0] + n[1] + n[2])]
    assert values(range(4), kind="random_walk", offset=2.0, sd=0.5) == pytest.approx(expected, rel=1e-14)


def test_ou_by_hand() -> None:
    # x' = x + 0.25 (1 - x) + 0.5 n from x = 1: 0.5 n_0, then 0.75 of it and 0.5 n_1 more, over the offset
    n = normals(2)
    expected = [1.0, 1.0 + 0.5 * n[0], 1.0 + 0.75 * 0.5 * n[0] + 0.5 * n[1]]
    found = values(range(3), kind="ou", offset=1.0, rate=0.25, sd=0.5)
    assert found == pytest.approx(expected, rel=1e-14)


def test_ou_keeps_to_its_stationary_spread() -> None:
    # sd / sqrt(1 - (1 - rate)^2) = 0.3 / sqrt(1 - 0.64) = 0.5
    found = values(range(20_000), kind="ou", offset=2.0, rate=0.2, sd=0.3)
    assert np.mean(found) == pytest.approx(2.0, abs=0.05)
    assert np.std(found) == pytest.approx(0.5, abs=0.03)


def test_noise_by_hand() -> None:
    expected = [1.0 + 0.5 * n for n in normals(3)]
    assert values(range(3), kind="noise", offset=1.0, sd=0.5) == pytest.approx(expected, rel=1e-14)


def _recorded(tmp_path: Path, text: str) -> DriftConfig:
    path = tmp_path / "drift.csv"
    path.write_text(text)
    return DriftConfig(kind="recorded", path=str(path))


def test_recorded_holds_the_newest_row(tmp_path: Path) -> None:
    drift = make_drift(_recorded(tmp_path, "note,unit,value\na,1,10\nb,2.5,20\nc,4,-1e1\n"), SEED)
    # before the first row the first; 2 is before 2.5; 3 after it
    assert [drift.value(t) for t in (0, 1, 2, 3, 4, 9)] == [10, 10, 10, 20, -10, -10]
    assert drift.lowest == -10


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must have a column 'unit' in its first line"),
        ("unit,speed\n1,2\n", "must have a column 'value' in its first line"),
        ("unit,value\n", "must have at least one row"),
        ("unit,value\n0,1\n1,nan\n", "line 3: value must be a finite number, not 'nan'"),
        ("unit,value\n0,1\n1,\n", "line 3: value must be a finite number, not ''"),
        ("unit,value\n0,1\n1\n", "line 3: value must be a finite number, not ''"),
        ("unit,value\nzero,1\n", "line 2: unit must be a finite number, not 'zero'"),
        ("unit,value\n0,1\n2,1\n1,1\n", "line 4: units must rise, but 1 follows 2"),
        ("unit,value\n0,1\n0,1\n", "line 3: units must rise, but 0 follows 0"),
        ("unit,value\n0," + "1" * 200_000 + "\n", "must be a CSV file (field larger than"),
    ],
)
def test_a_file_that_is_no_series(tmp_path: Path, text: str, message: str) -> None:
    config = _recorded(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        make_drift(config, SEED)
    assert str(caught.value).startswith(f"env.drift.path = {config.path!r}: {message}")
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "bytes.csv").write_bytes(b"unit,value\n0,\xff\xfe\n")
    for path, message in (
        ("", "must be a CSV file with the columns unit and value"),
        (str(tmp_path / "none.csv"), "must be a readable file (No such file or directory)"),
        (str(tmp_path), "must be a readable file (Is a directory)"),
        (str(tmp_path / "bytes.csv"), "must be a CSV file ('utf-8' codec"),
    ):
        with pytest.raises(ConfigError) as caught:
            make_drift(DriftConfig(kind="recorded", path=path), SEED)
        assert str(caught.value).startswith(f"env.drift.path = {path!r}: {message}")


def test_the_message_names_the_quantity_and_paths_become_absolute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "g.csv").write_text("unit,value\n0,1\n")
    recorded = DriftConfig(kind="recorded", path="g.csv")
    env = EnvConfig(id="pointmass", drift=recorded, physics=PhysicsConfig(mass=recorded))
    resolved = resolve(env)
    assert resolved.drift.path == resolved.physics.mass.path == str(tmp_path / "g.csv")
    assert resolve(resolved) == resolved
    missing = DriftConfig(kind="recorded", path="none.csv")
    with pytest.raises(ConfigError, match=r"^env\.physics\.friction\.path = '.*/none\.csv': must be a read"):
        resolve(EnvConfig(id="pointmass", physics=PhysicsConfig(friction=missing)))


def test_bounds_clip_any_kind_and_a_walk_goes_on_behind_them() -> None:
    sine = {"kind": "sine", "amplitude": 2.0, "omega": math.pi / 2}
    assert values(range(4), **sine, low=-1.0, high=0.5) == pytest.approx([0.0, 0.5, 0.0, -1.0], abs=1e-15)
    free = values(range(50), kind="random_walk", sd=1.0)
    bound = values(range(50), kind="random_walk", sd=1.0, low=-1.0, high=1.0)
    assert bound == [min(max(x, -1.0), 1.0) for x in free]
    assert max(map(abs, free)) > 1.0


@pytest.mark.parametrize("kind", ["ramp", "switch", "burst"])
def test_a_random_instant_is_drawn_once_from_the_span(kind: DriftKind) -> None:
    begins = []
    for seed in range(200):
        fields: dict[str, Any] = {"kind": kind, "amplitude": 1.0, "at": "random", "span": 50}
        drift = make_drift(DriftConfig(**fields), seed)
        again = make_drift(DriftConfig(**fields), seed)
        moved = [drift.value(t) for t in range(110)]
        assert [again.value(t) for t in range(110)] == moved
        begins.append(next(t for t, x in enumerate(moved) if x > 0) if any(moved) else -1)
    assert min(begins) >= 0 and max(begins) <= 50  # the first whole unit after it
    assert len(set(begins)) > 30  # of 50: all but uniform would show less
    assert np.mean(begins) == pytest.approx(25.5, abs=3.1)  # 3 standard errors of 14.4 / sqrt(200)


RANDOM_KINDS = ("random_walk", "ou", "noise")


@pytest.mark.parametrize("kind", RANDOM_KINDS)
def test_random_values_do_not_depend_on_who_asks_first_for_what(kind: DriftKind) -> None:
    config = DriftConfig(kind=kind, sd=1.0)
    ahead = make_drift(config, SEED)
    in_order = [ahead.value(t) for t in range(1000)]
    units = [*range(1000)] * 2
    random.Random(0).shuffle(units)
    jumping = make_drift(config, SEED)
    assert [jumping.value(t) for t in units] == [in_order[t] for t in units]


@pytest.mark.parametrize("kind", RANDOM_KINDS)
def test_seeds_and_streams_keep_random_drifts_apart(kind: DriftKind) -> None:
    def series(config: DriftConfig, seed: int, stream: int = TARGET) -> tuple[float, ...]:
        drift = make_drift(config, seed, stream=stream)
        return tuple(drift.value(t) for t in range(1, 9))

    config, own = DriftConfig(kind=kind, sd=1.0), DriftConfig(kind=kind, sd=1.0, seed=3)
    assert (
        len({series(config, 0), series(config, 1), series(config, 0, MASS), series(config, 0, FRICTION)}) == 4
    )
    assert series(own, 0) == series(own, 1) == series(config, 3)  # its own seed rules, not the run's


@pytest.mark.parametrize(
    ("fields", "lowest"),
    [
        ({"kind": "none"}, 0.0),
        ({"kind": "constant", "offset": 2.0}, 2.0),
        ({"kind": "sine", "offset": 1.0, "amplitude": -3.0}, -2.0),
        ({"kind": "square", "offset": 1.0, "amplitude": 3.0}, -2.0),
        ({"kind": "ramp", "offset": 1.0, "amplitude": -3.0}, -2.0),
        ({"kind": "switch", "offset": 1.0, "amplitude": 3.0}, 1.0),
        ({"kind": "burst", "offset": 1.0, "amplitude": -3.0, "low": -1.0}, -1.0),
        ({"kind": "ou", "sd": 1.0}, -math.inf),
        ({"kind": "ou", "sd": 1.0, "low": 0.5}, 0.5),
        ({"kind": "noise", "offset": 2.0}, 2.0),
    ],
)
def test_lowest_value(fields: dict[str, Any], lowest: float) -> None:
    drift = make_drift(DriftConfig(**fields), SEED)
    assert drift.lowest == lowest
    assert min(drift.value(t) for t in range(200)) >= lowest


def test_every_kind_can_be_made_and_a_still_one_is_zero(tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("unit,value\n0,1\n")
    for kind in get_args(DriftKind):
        config = DriftConfig(kind=kind, path=str(tmp_path / "d.csv"))
        drift: Drift = make_drift(config, SEED)
        assert config.still == (kind != "recorded")
        assert {drift.value(t) for t in range(20)} == ({0.0} if config.still else {1.0})
    assert not DriftConfig(kind="constant", offset=1.0).still
    assert not DriftConfig(kind="switch", amplitude=1.0).still
    assert not DriftConfig(kind="noise", sd=1.0).still
    assert not DriftConfig(kind="sine", low=1.0).still
    assert DriftConfig(kind="constant", amplitude=1.0, sd=1.0).still  # another kind's fields
