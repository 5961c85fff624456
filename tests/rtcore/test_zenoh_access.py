"""Who may write what, read off the rules as Zenoh reads them: the first that fits allows."""

from __future__ import annotations

from typing import Any

from rtcore import channels
from rtcore.signing import OPERATOR, ROLES
from rtcore.zenoh_access import access_control

RULES: Any = access_control("tenuto/run")


def allowed(role: str, message: str) -> set[str]:
    """The keys below the run's on which `role` may send `message` to somebody."""
    (policy,) = (one for one in RULES["policies"] if one["subjects"] == [role])
    rules = [one for one in RULES["rules"] if one["id"] in policy["rules"] and one["flows"] == ["ingress"]]
    keys = {key for one in rules if message in one["messages"] for key in one["key_exprs"]}
    assert all(key.startswith("tenuto/run/") for key in keys)
    return {key.removeprefix("tenuto/run/") for key in keys}


def with_cache(*keys: str) -> set[str]:
    return {*keys, *(f"{key}/@adv/**" for key in keys)}


def named(key: str) -> tuple[str, str]:
    """A key that ends with the name of an env server or an agent, and those of a fleet's."""
    return key, f"{key}.$*"


def test_each_role_writes_its_own_channels() -> None:
    assert {role: allowed(role, "put") for role in ROLES} == {
        channels.ENV_SERVER: with_cache("env/*/spec", "env/*/step", "env/*/log", *named("stats/env_server")),
        channels.AGENT: with_cache("env/*/action", *named("stats/agent_service")),
        channels.LEARNER: with_cache("policy", "window", "stats/learner"),
        channels.RECORDER: with_cache("stats/recorder"),
        OPERATOR: with_cache("stats/launcher"),
    }
    for role in ROLES:
        assert allowed(role, "delete") == allowed(role, "put")


def test_nobody_answers_for_another() -> None:
    for role in channels.PROCESSES:
        names = named if role in (channels.ENV_SERVER, channels.AGENT) else lambda key: (key,)
        answers = allowed(role, "put") | {"flush", *names(f"control/{role}")}
        assert allowed(role, "reply") == allowed(role, "declare_queryable") == answers
        assert allowed(role, "liveliness_token") == allowed(role, "put") | {*names(f"alive/{role}")}
    assert allowed(OPERATOR, "declare_queryable") == with_cache("stats/launcher") | {"flush"}
    assert allowed(OPERATOR, "liveliness_token") == with_cache("stats/launcher")


def test_only_the_operator_gives_orders() -> None:
    for role in ROLES:
        orders = {"control/*"} if role == OPERATOR else set()
        assert allowed(role, "query") == {"**/@adv/**", "flush"} | orders


def test_everybody_reads_and_what_is_not_named_is_denied() -> None:
    assert RULES["enabled"] and RULES["default_permission"] == "deny"
    assert {one["permission"] for one in RULES["rules"]} == {"allow"}
    for role in ROLES:
        assert allowed(role, "declare_subscriber") == {"**", "**/@adv/**"}
    assert [one["cert_common_names"] for one in RULES["subjects"]] == [[role] for role in ROLES]
