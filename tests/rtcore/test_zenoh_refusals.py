"""What Zenoh 1.10 writes about access, and what of it was a refusal."""

from __future__ import annotations

from collections.abc import Sequence

from rtcore.clock import VirtualClock
from rtcore.ledger import Ledger
from rtcore.zenoh_refusals import Refusal, Refusals
from rtcore.zenoh_watch import MOST_TOLD, TOLD_NS, Watch

ACL = "zenoh::net::routing::interceptor::access_control"
WHO = "edb4 on Interface(lo)+CertCommonName(recorder)+Transport(Tls)+edb4"
ACTIONS = ("Query", "Reply", "Put", "Delete", "A", "B", "C", "D", "E")


def line(text: str, *, level: str = "TRACE", thread: str = " rx-1 ThreadId(12)", target: str = ACL) -> bytes:
    """As it is written to a terminal: with colours."""
    stamp = "\x1b[2m2026-11-22T11:07:28.562222Z\x1b[0m"
    return f"{stamp} \x1b[35m{level}\x1b[0m {thread} \x1b[2m{target}\x1b[0m\x1b[2m:\x1b[0m {text}\n".encode()


def named(key: str, *, refused: Sequence[str] = (), thread: str = " rx-1 ThreadId(12)") -> bytes:
    """What is written when a peer first names a key."""
    told = [f"ACL (ingress): caching permissions for `{key}` ..."]
    for action in ACTIONS:
        word = "unauthorized" if action in refused else "authorized"
        told.append(f"{WHO} is {word} to {action} (ingress) on {key}")
    return b"".join(line(text, thread=thread) for text in told)


def test_what_could_be_done_is_not_what_was_done() -> None:
    assert list(Refusals().feed(named("r/policy", refused=["Put", "Delete"]))) == []


def test_a_message_is_refused_whether_its_key_was_named_or_not() -> None:
    refusals = Refusals()
    data = (
        named("r/policy", refused=["Put"])
        + line("Using cached result: edb4 is unauthorized to Put (ingress) on r/policy")
        + line("Using cached result: edb4 is authorized to Query (ingress) on r/policy")
        + line(f"{WHO} is unauthorized to Put (ingress) on r/env/e/action")
        + line(f"{WHO} is authorized to Put (ingress) on r/stats/recorder")
    )
    assert list(refusals.feed(data)) == [
        Refusal("message", "recorder may not Put (ingress) on r/policy"),
        Refusal("message", "recorder may not Put (ingress) on r/env/e/action"),
    ]


def test_threads_do_not_mix() -> None:
    first, second = named("r/a", refused=["Put"]), named("r/b", refused=["Put"], thread="ThreadId(03)")
    lines = zip(first.splitlines(keepends=True), second.splitlines(keepends=True), strict=True)
    mixed = b"".join(part for pair in lines for part in pair)
    attempt = line(f"{WHO} is unauthorized to Put (ingress) on r/c", thread="ThreadId(03)")
    assert list(Refusals().feed(mixed + attempt)) == [
        Refusal("message", "recorder may not Put (ingress) on r/c")
    ]


def test_links_and_the_lines_of_others() -> None:
    data = (
        line(
            "peer sent no certificates. Hint: increase the system open file limit.",
            level="WARN",
            target="zenoh_link_tls::unicast",
        )
        + line("Access control is enabled", level="DEBUG", thread="ThreadId(01)")
        + b"somebody else's line\n"
        + line("retrying", level="WARN", target="zenoh::net::runtime")
    )
    assert list(Refusals().feed(data)) == [
        Refusal("link", "peer sent no certificates."),
        b"somebody else's line\n",
        line("retrying", level="WARN", target="zenoh::net::runtime"),
    ]


def test_lines_come_in_pieces() -> None:
    data = line("peer sent no certificates.", level="WARN", target="zenoh_link_tls::unicast")
    refusals = Refusals()
    found = [one for at in range(len(data)) for one in refusals.feed(data[at : at + 1])]
    assert found == [Refusal("link", "peer sent no certificates.")]


def test_all_is_counted_and_some_is_told() -> None:
    clock, ledger = VirtualClock(0), Ledger("agent_service", 1)
    watch = Watch(ledger, clock)

    def told() -> int:
        return len(ledger.stats(clock.now_ns(), final=True).events)

    bad = line(f"{WHO} is unauthorized to Put (ingress) on r/policy")
    assert watch.feed(bad * 100 + b"other\n") == b"other\n"
    assert (ledger.counter("link.denied"), told()) == (100, 1)
    for number in range(50):
        watch.feed(line(f"{WHO} is unauthorized to Put (ingress) on r/{number}"))
    assert (ledger.counter("link.denied"), told()) == (150, MOST_TOLD)
    clock.advance_ns(TOLD_NS)
    watch.feed(bad + line("no certificate", level="WARN", target="zenoh_link_tls"))
    assert (ledger.counter("link.denied"), ledger.counter("link.refused"), told()) == (151, 1, MOST_TOLD + 2)
