"""What each field of a run's configuration may be, by itself: a table of rules."""

from __future__ import annotations

import dataclasses
import re
import sys
from collections.abc import Callable
from typing import Literal, get_args, get_origin

MOST = 10**9  # of anything counted; as seconds (31 years) its nanoseconds still fit a 64-bit message field


@dataclasses.dataclass(frozen=True, slots=True)
class Rule:
    """What one field may be: the words for people and the test for us."""

    allowed: str
    holds: Callable[[object], bool]


def _number(interval: str) -> Rule:
    """A finite number in an interval, written as people write it: `(0, 1]` is 0 < x <= 1."""
    low, high = map(float, interval[1:-1].split(","))

    def holds(value: object) -> bool:
        return (
            isinstance(value, int | float)
            and not isinstance(value, bool)
            and abs(value) <= sys.float_info.max  # neither NaN nor infinite, nor an integer beyond
            and (low <= value if interval[0] == "[" else low < value)
            and (value <= high if interval[-1] == "]" else value < high)
        )

    return Rule(f"must be in {interval}", holds)


def _whole(least: int, most: int = MOST) -> Rule:
    def holds(value: object) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most

    return Rule(f"must be {least}" if least == most else f"must be an integer in {least}..{most}", holds)


def _text(pattern: str, allowed: str) -> Rule:
    compiled = re.compile(pattern)

    def holds(value: object) -> bool:
        return isinstance(value, str) and compiled.fullmatch(value) is not None

    return Rule(f"must be {allowed}", holds)


def _optional(rule: Rule) -> Rule:
    return Rule(f"{rule.allowed}, or left out", lambda value: value is None or rule.holds(value))


def _or_word(word: str, rule: Rule) -> Rule:
    return Rule(f"{rule.allowed}, or {word!r}", lambda value: value == word or rule.holds(value))


def _each(rule: Rule, least: int = 0) -> Rule:
    def holds(value: object) -> bool:
        return isinstance(value, tuple) and len(value) >= least and all(map(rule.holds, value))

    return Rule(f"each entry {rule.allowed}" + (f", {least} or more of them" if least else ""), holds)


def _choice(choices: tuple[object, ...]) -> Rule:
    return Rule(f"must be one of {', '.join(map(repr, choices))}", lambda value: value in choices)


# Names become parts of keys and of file names, so they keep clear of "/", of blanks and of the wildcards
# of key expressions (* $ # ?).
_NAME = _text(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", "1 to 64 of the characters A-Z a-z 0-9 _ . -")
_ENDPOINT = _text(
    r"(tcp|udp|tls|quic|ws|unixsock-stream)/[^\s]+", "protocol/address, like tls/192.0.2.1:7447"
)
_POSITIVE = _number("(0, inf)")
_FINITE = _number("(-inf, inf)")
_MODERATE = _number("[-1e12, 1e12]")  # sums and products with any unit stay finite


def _drift(prefix: str) -> dict[str, Rule]:
    fields = {
        "offset": _MODERATE,
        "amplitude": _MODERATE,
        "omega": _MODERATE,
        "phase": _MODERATE,
        "at": _or_word("random", _MODERATE),
        "span": _POSITIVE,
        "every": _number("[0, inf)"),
        "rate": _number("(0, 1]"),
        "sd": _number("[0, 1e12]"),
        "low": _optional(_FINITE),
        "high": _optional(_FINITE),
        "seed": _optional(_whole(0, 2**32 - 1)),
        "path": _text(r".{0,4096}", "a file's path"),
    }
    return {f"{prefix}.{name}": rule for name, rule in fields.items()}


RULES: dict[str, Rule] = {
    "preset": _NAME,
    "seed": _whole(0, 2**32 - 1),  # what NumPy and Gymnasium both take
    "duration_s": _number("[0, 1e9]"),
    "env.id": _text(r"[^\s]{1,200}", "an environment's name without blanks"),
    "env.name": _NAME,
    "env.hz": _optional(_number("[1e-6, 1e6]")),  # a tick of 1 us .. 10^6 s: never 0 ns
    "env.speed": _optional(_POSITIVE),
    "env.episode_steps": _whole(1),
    "env.unit_s": _number("[1e-6, 1e9]"),
    "env.action_delay_ticks": _whole(0),
    "env.observe_actions": _whole(0),
    "env.hold_ticks": _whole(0),
    "env.count": _whole(1, 16),  # each process has a link to every other one
    "env.start_wait_s": _number("[0, 1e9]"),
    **_drift("env.drift"),
    **_drift("env.physics.mass"),
    **_drift("env.physics.friction"),
    **_drift("env.physics.gravity"),
    "env.cliff.step_reward": _FINITE,
    "env.cliff.goal_reward": _FINITE,
    "env.cliff.restart_reward": _FINITE,
    "env.mdp.states": _whole(1, 10_000),
    "env.mdp.actions": _whole(1, 1000),
    "env.mdp.concentration": _POSITIVE,
    "env.mdp.slip": _number("[0, 1]"),
    "env.reward.k_f": _POSITIVE,
    "env.reward.control_cost": _number("[0, inf)"),
    "env.reward.healthy": _FINITE,
    "learner.utd": _POSITIVE,
    "learner.learning_starts": _whole(0),
    "learner.hidden": _each(_whole(1, 65_536), least=1),
    "learner.batch": _whole(1),
    "learner.gamma": _number("[0, 1]"),  # 1: for tables whose episodes end
    "learner.tau": _number("(0, 1]"),
    "learner.actor_lr": _POSITIVE,
    "learner.critic_lr": _POSITIVE,
    "learner.alpha": _or_word("auto", _POSITIVE),
    "learner.alpha_lr": _POSITIVE,
    "learner.target_entropy": _optional(_FINITE),
    "learner.replay_capacity": _whole(1),
    "learner.replay_units": _optional(_POSITIVE),
    "learner.replay_recency": _optional(_POSITIVE),
    "learner.threads": _whole(1, 1024),
    "learner.checkpoint_s": _number("(0, 1e9]"),
    "learner.schedule.l_f": _whole(1),
    "learner.schedule.gamma_f": _number("(0, 1]"),
    "learner.schedule.t_m": _each(_whole(0)),
    "learner.schedule.g_m": _each(_whole(1)),
    "learner.schedule.least_update": _whole(1),
    "learner.schedule.rate": _number("(0, 1]"),
    "learner.schedule.least_gain": _number("[0, 1]"),
    **{f"learner.schedule.bound.{name}": _number("[0, 1e20]") for name in ("c_1", "c_45", "b_1", "b_2")},
    **{f"learner.schedule.bound.{name}": _number("(0, 1e20]") for name in ("eta", "tau")},
    **{f"learner.schedule.bound.{name}": _number("(1, 1e20]") for name in ("alpha_1", "alpha_2")},
    "learner.forecast.l_p": _whole(1),
    "learner.forecast.every": _whole(1),
    "learner.forecast.degree": _whole(1, 20),
    "learner.forecast.period": _POSITIVE,
    "learner.forecast.harmonics": _whole(1, 100),
    "learner.forecast.horizon": _or_word("window", _or_word("replay", _number("[0, inf)"))),
    "learner.forecast.shrink": _number("[0, inf)"),
    "learner.reward.speed_entry": _whole(0),
    "learner.reward.hidden": _each(_whole(1, 65_536), least=1),
    "learner.reward.lr": _POSITIVE,
    "learner.reward.latent_lr": _POSITIVE,
    "learner.table.step_size": _number("(0, 1]"),
    "learner.table.epsilon": _number("[0, 1]"),
    "learner.table.initial": _FINITE,
    "learner.table.eta": _POSITIVE,
    "learner.table.entropy": _POSITIVE,
    "learner.table.write_back": _number("[0, 1]"),
    "learner.table.tempo_begin": _whole(0),
    "learner.table.tempo_span": _whole(1),
    "recorder.port": _whole(1, 65_535),
    "link.connect": _each(_ENDPOINT),
    "link.listen": _each(_ENDPOINT),
    "link.secure": _text(r".{0,4096}", "a directory's path"),
    "supervise.limit": _whole(0),
    "supervise.within_s": _number("(0, 1e9]"),
    "supervise.first_s": _number("[0, 1e9]"),
    "supervise.most_s": _number("[0, 1e9]"),
    "supervise.stuck_s": _number("[1, 1e9]"),  # loops turn several times a second
}
"""One row per field; fields that are a Literal or a bool have theirs from their type."""


def rule_for(name: str, hint: object) -> Rule:
    """The rule of the field `name` (dotted) of the type `hint`.

    Raises:
        KeyError: a field without a rule; a test keeps the table whole.
    """
    if get_origin(hint) is Literal:
        return _choice(get_args(hint))
    if hint is bool:
        return Rule("must be true or false", lambda value: isinstance(value, bool))
    return RULES[name]
