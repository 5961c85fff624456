"""Who may say what on secured links: Zenoh's access control, from the writers in the channel table.

Each process applies it to what comes in, by the common name of the certificate behind the link, so it
protects everybody who has it and nobody else. Reading is open to every certificate.
"""

from __future__ import annotations

from collections.abc import Iterator

from rtcore.channels import ALIVE_KEY, CONTROL_KEY, LAUNCHER, PER_ENV, TABLE
from rtcore.signing import OPERATOR, ROLES

FLUSH_KEY = "flush"  # query, empty reply: all that was sent to this process before has arrived

# Also what would let a stranger answer for a publisher: its cache is asked by query, and found by its token.
WRITING = ("put", "delete", "reply", "declare_queryable", "liveliness_token")
READING = ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
ANSWERING = ("declare_queryable", "reply")
EVERYTHING = (*WRITING, *READING, "query")


def access_control(namespace: str) -> dict[str, object]:
    """The section `access_control` of a session's settings, the same for every process of a run.

    Args:
        namespace: of the run's keys: rules are about keys as they are on the wire.
    """

    def rule(name: str, flow: str, messages: tuple[str, ...], *keys: str) -> dict[str, object]:
        return {
            "id": name,
            "permission": "allow",
            "flows": [flow],
            "messages": list(messages),
            "key_exprs": [f"{namespace}/{key}" for key in keys],
        }

    all_keys, caches = "**", "**/@adv/**"  # `**` does not match what begins with @
    common = [
        rule("send", "egress", EVERYTHING, all_keys, caches),
        rule("read", "ingress", READING, all_keys, caches),
        rule("history", "ingress", ("query",), caches),
        rule("flush", "ingress", ("query", *ANSWERING), FLUSH_KEY),
    ]
    own = {role: _own(role) for role in ROLES}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": common
        + [
            rule(f"{what}_{role}", "ingress", messages, *keys)
            for role, rules in own.items()
            for what, (messages, keys) in rules.items()
        ],
        "subjects": [{"id": role, "cert_common_names": [role]} for role in ROLES],
        "policies": [
            {
                "rules": [*(str(one["id"]) for one in common), *(f"{what}_{role}" for what in own[role])],
                "subjects": [role],
            }
            for role in ROLES
        ],
    }


def _own(role: str) -> dict[str, tuple[tuple[str, ...], list[str]]]:
    """What `role` alone may do: name of the rule -> messages and keys."""
    if role == OPERATOR:
        return {
            "write": (WRITING, list(_written(LAUNCHER))),
            "order": (("query",), [CONTROL_KEY.format(name="*")]),
        }
    return {
        "write": (WRITING, list(_written(role))),
        "live": (("liveliness_token",), [ALIVE_KEY.format(name=name) for name in _names(role)]),
        "obey": (ANSWERING, [CONTROL_KEY.format(name=name) for name in _names(role)]),
    }


def _names(role: str) -> tuple[str, ...]:
    """Of the processes with the certificate of `role`: in a fleet they are numbered."""
    return (role, f"{role}.$*") if role in PER_ENV else (role,)


def _written(writer: str) -> Iterator[str]:
    """The keys of the channels that `writer` writes, and of their caches."""
    for channel in TABLE:
        if writer in channel.writers:
            # Several writers on a channel have a name each; a single one writes for all environments.
            for name in _names(writer) if len(channel.writers) > 1 else ("*",):
                key = channel.key_for(name)
                yield from (key, f"{key}/@adv/**")
