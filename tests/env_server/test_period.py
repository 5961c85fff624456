from __future__ import annotations

import math

import pytest

from env_server.worlds.period import Timing, num_ticks, physics_steps, resolve_period, tick_ns
from rtcore.config import ConfigError, EnvConfig

CHEETAH = Timing(native_s=0.05, physics_s=0.01)
FIXED = Timing(native_s=0.05, physics_s=None)
TIMELESS = Timing(native_s=None, physics_s=None)


@pytest.mark.parametrize(
    ("hz", "speed", "resolved", "steps"),
    [
        (None, None, (20.0, 1.0), 5),
        (None, 10.0, (200.0, 10.0), 5),
        (100.0, None, (100.0, 5.0), 5),
        (200.0, 10.0, (200.0, 10.0), 5),
        (200.0, 2.0, (200.0, 2.0), 1),  # 10 ms per tick, one physics step
        (30.0, 0.9, (30.0, 0.9), 3),  # 0.9 / 30 is not exactly 0.03
        (10.0, 1.0, (10.0, 1.0), 10),
    ],
)
def test_one_follows_from_the_other(
    hz: float | None, speed: float | None, resolved: tuple[float, float], steps: int
) -> None:
    env = resolve_period(EnvConfig(hz=hz, speed=speed), CHEETAH)
    assert (env.hz, env.speed) == pytest.approx(resolved, rel=1e-12)
    assert physics_steps(env, CHEETAH) == steps
    assert resolve_period(env, CHEETAH) == env


@pytest.mark.parametrize(
    ("hz", "speed"), [(200.0, 3.0), (200.0, 1.0), (60.0, 1.0), (1000.0, 1.0), (1e6, 1e-3)]
)
def test_a_period_of_broken_physics_steps_is_refused(hz: float, speed: float) -> None:
    with pytest.raises(
        ConfigError, match=r"^env.speed = .* is no whole multiple of the physics step of 0.01 s"
    ):
        resolve_period(EnvConfig(hz=hz, speed=speed), CHEETAH)


def test_the_message_says_what_the_period_is() -> None:
    with pytest.raises(ConfigError) as caught:
        resolve_period(EnvConfig(hz=200.0, speed=3.0), CHEETAH)
    assert str(caught.value) == (
        "env.speed = 3.0: at env.hz = 200 the period of 0.015 s is no whole multiple of the physics step of "
        "0.01 s; leave env.hz or env.speed out for the native period"
    )


def test_a_fixed_step_takes_its_own_period_only() -> None:
    env = resolve_period(EnvConfig(id="Pendulum-v1", hz=40.0), FIXED)
    assert (env.hz, env.speed, physics_steps(env, FIXED)) == (40.0, 2.0, 1)
    assert resolve_period(EnvConfig(hz=40.0, speed=2.0), FIXED).speed == 2.0
    for speed in (1.0, 4.0):
        with pytest.raises(ConfigError, match=r"env.speed = .* is not the fixed step of 0.05 s"):
            resolve_period(EnvConfig(hz=40.0, speed=speed), FIXED)


def test_a_world_without_a_time_scale_needs_a_rate_and_has_no_speed() -> None:
    env = resolve_period(EnvConfig(id="X-v0", hz=30.0), TIMELESS)
    assert (env.hz, env.speed, physics_steps(env, TIMELESS)) == (30.0, None, 1)
    with pytest.raises(ConfigError, match=r"^env.hz = None: needed, since X-v0 has no native period"):
        resolve_period(EnvConfig(id="X-v0"), TIMELESS)
    with pytest.raises(ConfigError, match=r"^env.speed = 2.0: X-v0 has no native period"):
        resolve_period(EnvConfig(id="X-v0", hz=30.0, speed=2.0), TIMELESS)


@pytest.mark.parametrize("bad", [-1.0, 0.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["hz", "speed"])
def test_rates_are_positive(name: str, bad: float) -> None:
    env = EnvConfig(hz=bad) if name == "hz" else EnvConfig(speed=bad)
    with pytest.raises(ConfigError, match=f"^env.{name} = .*: a finite number above 0"):
        resolve_period(env, CHEETAH)


def test_tick_ns() -> None:
    assert tick_ns(EnvConfig(hz=200.0)) == 5_000_000
    assert tick_ns(EnvConfig(hz=30.0)) == 33_333_333
    with pytest.raises(ConfigError, match=r"env.hz"):
        tick_ns(EnvConfig())


@pytest.mark.parametrize(
    ("hz", "duration_s", "count"),
    [
        (100.0, 40.0, 4000),
        (600.0, 7200.0, 4_319_999),  # 7200 s / 1 666 667 ns = 4 319 999.1; duration times rate is one more
        (1900.0, 1800.0, 3_419_999),  # 1800 s / 526 316 ns = 3 419 998.6; likewise
        (0.5, 0.1, 1),
        (100.0, 0.0, 0),
    ],
)
def test_deadlines_are_counted_by_the_whole_nanoseconds_of_a_period(
    hz: float, duration_s: float, count: int
) -> None:
    assert num_ticks(EnvConfig(hz=hz), duration_s) == count
