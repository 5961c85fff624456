from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, Literal, get_origin, get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcore.config import ConfigError, ForecastConfig, LearnerConfig, RunConfig, ScheduleConfig
from rtcore.config_check import check, check_unit
from rtcore.config_rules import RULES, rule_for

INF, NAN = float("inf"), float("nan")


def replaced(section: Any, dotted: str, value: object) -> Any:
    """`section` with the field `dotted` set to `value`."""
    head, _, rest = dotted.partition(".")
    inner = replaced(getattr(section, head), rest, value) if rest else value
    return dataclasses.replace(section, **{head: inner})


def leaves(kind: type, prefix: str = "") -> Iterator[tuple[str, object]]:
    for key, hint in get_type_hints(kind).items():
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            yield from leaves(hint, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", hint


def test_the_defaults_are_valid() -> None:
    check(RunConfig())


def test_every_field_has_a_rule_and_every_rule_a_field() -> None:
    fields = dict(leaves(RunConfig))
    assert len(fields) >= 50
    for name, hint in fields.items():
        rule_for(name, hint)
    by_type = {name for name, hint in fields.items() if hint is bool or get_origin(hint) is Literal}
    assert by_type.isdisjoint(RULES)
    assert set(fields) == by_type | set(RULES)


def test_no_field_takes_anything() -> None:
    for name, _ in leaves(RunConfig):
        with pytest.raises(ConfigError) as error:
            check(replaced(RunConfig(), name, object()))
        assert error.value.name == name


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("learner.schedule.gamma_f", 1.5, "must be in (0, 1]"),
        ("learner.schedule.gamma_f", 0.0, "must be in (0, 1]"),
        ("learner.schedule.gamma_f", NAN, "must be in (0, 1]"),
        ("learner.schedule.gamma_f", True, "must be in (0, 1]"),
        ("learner.schedule.l_f", 0, "must be an integer in 1..1000000000"),
        ("learner.schedule.l_f", 10.0, "must be an integer in 1..1000000000"),
        ("learner.schedule.kind", "daily", None),
        ("learner.schedule.rounding", "round", "must be one of 'floor', 'ceil', 'paper_le'"),
        ("learner.schedule.t_m", (0, 1.5), "each entry must be an integer in 0..1000000000"),
        ("learner.schedule.t_m", [0], "each entry must be an integer in 0..1000000000"),
        ("learner.schedule.g_m", (0,), "each entry must be an integer in 1..1000000000"),
        ("preset", "", "must be 1 to 64 of the characters A-Z a-z 0-9 _ . -"),
        ("preset", "../up", "must be 1 to 64 of the characters A-Z a-z 0-9 _ . -"),
        ("seed", -1, "must be an integer in 0..4294967295"),
        ("seed", 2**32, "must be an integer in 0..4294967295"),
        ("duration_s", -1.0, "must be in [0, 1e9]"),
        ("duration_s", INF, "must be in [0, 1e9]"),
        ("env.id", "", "must be an environment's name without blanks"),
        ("env.name", "env/*", "must be 1 to 64 of the characters A-Z a-z 0-9 _ . -"),
        ("env.name", "env0\n", "must be 1 to 64 of the characters A-Z a-z 0-9 _ . -"),
        ("env.hz", 0.0, "must be in [1e-6, 1e6], or left out"),
        ("env.hz", -50.0, "must be in [1e-6, 1e6], or left out"),
        ("env.hz", INF, "must be in [1e-6, 1e6], or left out"),
        ("env.hz", "fast", "must be in [1e-6, 1e6], or left out"),
        ("env.speed", 0, "must be in (0, inf), or left out"),
        ("env.speed", INF, "must be in (0, inf), or left out"),
        ("env.speed", 10**400, "must be in (0, inf), or left out"),
        ("env.episode_steps", 0, "must be an integer in 1..1000000000"),
        ("env.unit_s", 0.0, "must be in [1e-6, 1e9]"),
        ("env.action_delay_ticks", -1, "must be an integer in 0..1000000000"),
        ("env.observe_actions", -1, "must be an integer in 0..1000000000"),
        ("env.on_miss", "panic", "must be one of 'hold', 'neutral', 'hold_then_neutral'"),
        ("env.hold_ticks", -1, "must be an integer in 0..1000000000"),
        ("env.count", 17, "must be an integer in 1..16"),
        ("env.start_wait_s", -0.1, "must be in [0, 1e9]"),
        ("env.drift.kind", "steps", None),
        ("env.drift.offset", NAN, "must be in [-1e12, 1e12]"),
        ("env.drift.amplitude", INF, "must be in [-1e12, 1e12]"),
        ("env.drift.omega", -INF, "must be in [-1e12, 1e12]"),
        ("env.drift.phase", None, "must be in [-1e12, 1e12]"),
        ("env.reward.k_f", 0.0, "must be in (0, inf)"),
        ("env.reward.control_cost", -0.1, "must be in [0, inf)"),
        ("env.reward.healthy", NAN, "must be in (-inf, inf)"),
        ("agent.rt", "on", "must be one of 'auto', 'off', 'require'"),
        ("learner.algo", "ppo", None),
        ("learner.utd", 0.0, "must be in (0, inf)"),
        ("learner.hold_learning", "quarter", "must be one of 'full', 'half', 'off'"),
        ("learner.learning_starts", -1, "must be an integer in 0..1000000000"),
        ("learner.hidden", (), "each entry must be an integer in 1..65536, 1 or more of them"),
        ("learner.hidden", (256, 0), "each entry must be an integer in 1..65536, 1 or more of them"),
        ("learner.batch", 0, "must be an integer in 1..1000000000"),
        ("learner.gamma", 1.0, "must be below 1 for sac"),
        ("learner.gamma", -0.1, "must be in [0, 1]"),
        ("learner.tau", 0.0, "must be in (0, 1]"),
        ("learner.tau", 1.1, "must be in (0, 1]"),
        ("learner.actor_lr", 0.0, "must be in (0, inf)"),
        ("learner.critic_lr", -3e-4, "must be in (0, inf)"),
        ("learner.alpha", 0.0, "must be in (0, inf), or 'auto'"),
        ("learner.alpha", "fixed", "must be in (0, inf), or 'auto'"),
        ("learner.alpha_lr", NAN, "must be in (0, inf)"),
        ("learner.target_entropy", NAN, "must be in (-inf, inf), or left out"),
        ("learner.replay_capacity", 0, "must be an integer in 1..1000000000"),
        ("learner.replay_capacity", 100, None),  # smaller than the batch: see below
        ("learner.replay_units", 0.0, "must be in (0, inf), or left out"),
        ("learner.threads", 0, "must be an integer in 1..1024"),
        ("learner.forecast.kind", "oracle", "must be one of 'none', 'forq'"),
        ("learner.forecast.l_p", 0, "must be an integer in 1..1000000000"),
        ("learner.forecast.l_p", 1, "must be >= 2 for the identity basis"),
        (
            "learner.forecast.basis",
            "spline",
            "must be one of 'constant', 'identity', 'polynomial', 'fourier'",
        ),
        ("learner.forecast.degree", 0, "must be an integer in 1..20"),
        ("learner.table.epsilon", 1.5, "must be in [0, 1]"),
        ("env.drift.omega", 1e308, "must be in [-1e12, 1e12]"),
        ("env.drift.at", "soon", "must be in [-1e12, 1e12], or 'random'"),
        ("env.physics.gravity.rate", 0.0, "must be in (0, 1]"),
        ("learner.forecast.horizon", -1.0, "must be in [0, inf), or 'replay', or 'window'"),
        ("learner.schedule.least_gain", 1.5, "must be in [0, 1]"),
        ("learner.schedule.bound.alpha_1", 1.0, "must be in (1, 1e20]"),
        ("learner.forecast.shrink", -1.0, "must be in [0, inf)"),
        ("learner.forecast.trust", "judge", "must be one of 'always', 'judged', 'never'"),
        ("recorder.record", 1, "must be true or false"),
        ("recorder.detail", "some", "must be one of 'full', 'light'"),
        ("recorder.view", "vr", "must be one of 'none', 'web', 'native'"),
        ("recorder.port", 0, "must be an integer in 1..65535"),
        ("recorder.port", 65_536, "must be an integer in 1..65535"),
        ("link.connect", ("localhost",), "each entry must be protocol/address, like tls/192.0.2.1:7447"),
        ("link.listen", ("http/x:1",), "each entry must be protocol/address, like tls/192.0.2.1:7447"),
        ("learner.checkpoint_s", 0.0, "must be in (0, 1e9]"),
        ("supervise.first_s", -0.1, "must be in [0, 1e9]"),
        ("supervise.first_s", 5.1, "must be <= supervise.most_s, which is 5"),
        ("supervise.stuck_s", 0.5, "must be in [1, 1e9]"),
    ],
)
def test_what_is_out_of_range_is_named(name: str, value: object, allowed: str | None) -> None:
    with pytest.raises(ConfigError) as error:
        check(replaced(RunConfig(), name, value))
    if allowed is not None:
        assert str(error.value) == f"{name} = {value!r}: {allowed}"
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("learner.schedule.gamma_f", 1.0),
        ("learner.schedule.gamma_f", 1),
        ("learner.schedule.gamma_f", 1e-9),
        ("learner.schedule.l_f", 1),
        ("seed", 2**32 - 1),
        ("duration_s", 0),
        ("env.id", "ALE/Pong-v5"),
        ("env.hz", 1000),
        ("env.speed", 2.5),
        ("env.unit_s", 1e-6),
        ("learner.gamma", 0.0),
        ("learner.tau", 1.0),
        ("learner.alpha", 0.2),
        ("learner.target_entropy", -6.0),
        ("learner.replay_units", 20),
        ("learner.forecast.horizon", 0.0),
        ("recorder.record", False),
        ("link.listen", ("tls/0.0.0.0:7447", "unixsock-stream//tmp/a.sock")),
    ],
)
def test_the_edges_are_allowed(name: str, value: object) -> None:
    check(replaced(RunConfig(), name, value))


def failure(*changes: tuple[str, object]) -> str:
    config = RunConfig()
    for name, value in changes:
        config = replaced(config, name, value)
    with pytest.raises(ConfigError) as error:
        check(config)
    return str(error.value)


def test_a_unit_holds_a_tick_or_more() -> None:
    for hz, unit_s in ((20, 0.05), (10, 0.1), (3, 0.333333333), (0.5, 2)):
        check(replaced(replaced(RunConfig(), "env.hz", hz), "env.unit_s", unit_s))
        check_unit(unit_s, hz)
    message = "env.unit_s = 0.04: must be at least one tick, 0.05 s at 20 Hz"
    assert failure(("env.hz", 20), ("env.unit_s", 0.04)) == message


def test_a_line_through_the_past_needs_two_critics() -> None:
    one = replaced(RunConfig(), "learner.forecast.l_p", 1)
    check(replaced(one, "learner.forecast.basis", "constant"))
    check(replaced(one, "learner.forecast.kind", "none"))


def test_the_replay_holds_a_batch_and_what_learning_waits_for() -> None:
    suffix = "must be <= learner.replay_capacity, which is 400"
    assert failure(("learner.replay_capacity", 400)) == f"learner.learning_starts = 500: {suffix}"
    assert (
        failure(("learner.replay_capacity", 400), ("learner.batch", 401)) == f"learner.batch = 401: {suffix}"
    )


def test_the_replay_may_be_no_larger_than_needed() -> None:
    exact = replaced(RunConfig(), "learner.replay_capacity", 500)
    check(replaced(exact, "learner.batch", 500))


def test_lists_count_for_the_explicit_schedule_alone() -> None:
    odd = replaced(RunConfig(), "learner.schedule.t_m", (3, 1))
    check(odd)
    explicit = failure(("learner.schedule.kind", "explicit"), ("learner.schedule.t_m", (3, 1)))
    assert explicit == "learner.schedule.t_m = (3, 1): must start with 0"
    paper = replaced(odd, "learner.schedule.t_m", (0, 13, 25))
    paper = replaced(paper, "learner.schedule.g_m", (10, 4, 5))
    check(replaced(paper, "learner.schedule.kind", "explicit"))


def test_the_largest_policy_step_is_allowed_as_it_is_named() -> None:
    npg = replaced(RunConfig(), "learner.algo", "npg")
    npg = replaced(replaced(npg, "learner.gamma", 0.9), "learner.table.entropy", 1.0)
    check(replaced(npg, "learner.table.eta", 0.1))
    with pytest.raises(ConfigError, match=r"learner.table.eta = 0.101: must be <= .*, which is 0.1$"):
        check(replaced(npg, "learner.table.eta", 0.101))


def test_a_table_learns_in_a_hold_from_all_or_nothing() -> None:
    q = replaced(RunConfig(), "learner.algo", "q")
    check(replaced(q, "learner.hold_learning", "off"))
    with pytest.raises(ConfigError, match=r"learner.hold_learning = 'half': must be 'full' or 'off' for q"):
        check(replaced(q, "learner.hold_learning", "half"))


def test_a_section_is_a_section() -> None:
    assert failure(("env", {"hz": 50})).startswith("env = {'hz': 50}: must be of type EnvConfig")


@given(low=st.floats(), value=st.floats())
def test_intervals_are_what_they_say(low: float, value: float) -> None:
    assert RULES["learner.gamma"].holds(value) == (0 <= value <= 1)
    assert RULES["learner.tau"].holds(value) == (0 < value <= 1)
    assert RULES["learner.utd"].holds(low) == (0 < low < INF)
    assert RULES["env.reward.healthy"].holds(low) == (-INF < low < INF)


@pytest.mark.parametrize("name", ["env.drift", "env.physics.gravity"])
def test_a_drift_is_consistent(name: str) -> None:
    message = f"{name}.low = 2.0: must be <= {name}.high, which is 1"
    assert failure((f"{name}.low", 2.0), (f"{name}.high", 1.0)) == message
    burst: list[tuple[str, object]] = [(f"{name}.kind", "burst"), (f"{name}.span", 3.0)]
    message = f"{name}.every = 3.0: must be above {name}.span, which is 3, or 0 for one burst"
    assert failure(*burst, (f"{name}.every", 3.0)) == message
    config = RunConfig()
    for field, value in [*burst, (f"{name}.every", 3.5), (f"{name}.low", 1.0), (f"{name}.high", 1.0)]:
        config = replaced(config, field, value)
    check(config)


@pytest.mark.parametrize(
    ("learner", "message"),
    [
        ({"algo": "rsac"}, "learner.schedule.kind = 'auto': must go with learner.algo npg or fsac"),
        (
            {"algo": "npg", "forecast": ForecastConfig(kind="none")},
            "learner.schedule.kind = 'auto': must have a forecast to choose by",
        ),
        (
            {"algo": "fsac", "forecast": ForecastConfig(parity="authors")},
            "learner.schedule.kind = 'auto': must have a forecast to choose by",
        ),
        (
            {"algo": "npg", "schedule": ScheduleConfig(kind="auto", l_f=3, least_update=4)},
            "learner.schedule.least_update = 4: must be <= learner.schedule.l_f, which is 3",
        ),
        (
            {"algo": "fsac", "schedule": ScheduleConfig(kind="auto_bound")},
            "learner.schedule.kind = 'auto_bound': must go with learner.algo npg,",
        ),
    ],
)
def test_a_schedule_that_chooses_has_something_to_choose_by(learner: dict[str, Any], message: str) -> None:
    fields: dict[str, Any] = {"schedule": ScheduleConfig(kind="auto")} | learner
    with pytest.raises(ConfigError) as error:
        check(RunConfig(learner=LearnerConfig(**fields)))
    assert str(error.value).startswith(message)
