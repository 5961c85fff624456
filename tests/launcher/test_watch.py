from __future__ import annotations

import pytest

from launcher.restarts import Happening, What
from launcher.watch import Watch
from rtcore.channels import ENV_SERVER, LEARNER
from rtcore.messages import Event
from tests.launcher.ledgers import episode, ledger, notice

SECOND = 1_000_000_000


def test_rates_are_over_the_last_two_seconds() -> None:
    watch = Watch(100.0)
    assert watch.rate(ENV_SERVER, "ticks") is None
    ticks = 0
    for quarter in range(40):
        ticks += 25 if quarter < 20 else 50
        stats = ledger(ENV_SERVER, seq=quarter, at_ns=quarter * SECOND // 4, counters={"ticks": ticks})
        watch.feed(stats, received_ns=stats.at_ns)
        if quarter == 0:
            assert watch.rate(ENV_SERVER, "ticks") is None
        if quarter == 19:
            assert watch.rate(ENV_SERVER, "ticks") == 100.0
    assert watch.rate(ENV_SERVER, "ticks") == 200.0


def test_a_restart_begins_a_rate_anew_and_keeps_the_old_ledger() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(ENV_SERVER, at_ns=SECOND, counters={"ticks": 100}), 1)
    watch.feed(ledger(ENV_SERVER, incarnation=2, at_ns=2 * SECOND, counters={"ticks": 10}), 2)
    assert watch.rate(ENV_SERVER, "ticks") is None
    assert watch.totals(ENV_SERVER).counters["ticks"] == 110


def test_returns_are_kept_though_messages_carry_only_the_newest() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(ENV_SERVER, seq=0, returns=[episode(0, 1.0), episode(1, 2.0)]), 1)
    watch.feed(ledger(ENV_SERVER, seq=1, returns=[episode(1, 2.0), episode(2, 3.0)]), 2)
    (kept,) = watch.stats()[ENV_SERVER]
    assert [one.value for one in kept.returns] == [1.0, 2.0, 3.0]


def test_a_screen_gets_the_newest_returns_and_the_best_and_the_summary_all() -> None:
    values = [1000.0 if number == 5 else float(number % 97) for number in range(200)]
    watch = Watch(100.0)
    for seq, last in enumerate((40, 100, 64, 164, 200)):  # the third one was overtaken; each has the last 64
        newest = [episode(number, values[number]) for number in range(max(0, last - 64), last)]
        watch.feed(ledger(ENV_SERVER, seq=seq, returns=newest), seq)
    for _ in range(2):  # also once its last words have been read
        assert watch.totals(ENV_SERVER).returns == [1000.0, *values[-60:]]
        (kept,) = watch.stats()[ENV_SERVER]
        assert [one.value for one in kept.returns] == values
        everything = [episode(*one) for one in enumerate(values)]
        watch.feed_final([ledger(ENV_SERVER, seq=9, final=True, returns=everything)])


def test_up_to_sixty_returns_are_shown_as_they_are() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(ENV_SERVER, returns=[episode(number, float(number % 7)) for number in range(60)]), 1)
    assert watch.totals(ENV_SERVER).returns == [float(number % 7) for number in range(60)]


def test_an_overtaken_message_changes_nothing() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(ENV_SERVER, seq=5, counters={"ticks": 50}), 1)
    watch.feed(ledger(ENV_SERVER, seq=4, counters={"ticks": 40}), 2)
    assert watch.totals(ENV_SERVER).counters["ticks"] == 50


def test_the_final_ledger_replaces_what_was_heard() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(ENV_SERVER, seq=5, counters={"ticks": 50}), 1)
    watch.feed_final(
        [ledger(ENV_SERVER, seq=6, final=True, counters={"ticks": 60}, returns=[episode(0, 1.0)])]
    )
    (kept,) = watch.stats()[ENV_SERVER]
    assert kept.final
    assert kept.counters == {"ticks": 60}
    assert [one.value for one in kept.returns] == [1.0]


@pytest.mark.parametrize(("age_s", "health"), [(0.5, "alive"), (3.0, "late"), (60.0, "missing")])
def test_health_follows_from_the_last_message(age_s: float, health: str) -> None:
    watch = Watch(100.0)
    assert watch.health(ENV_SERVER, 0) == "missing"
    watch.feed(ledger(ENV_SERVER), received_ns=SECOND)
    assert watch.health(ENV_SERVER, SECOND + int(age_s * SECOND)) == health


def test_events_and_the_phase() -> None:
    watch = Watch(100.0)
    assert watch.phase() is None
    event = Event(at_ns=1, level="WARN", text="hello")
    watch.feed(ledger(LEARNER, windows=[notice(0, "update"), notice(0, "hold")], events=[event]), 1)
    phase = watch.phase()
    assert phase is not None
    assert phase.phase == "hold"
    assert list(watch.events) == [(LEARNER, event)]


def test_the_tally_of_a_life_that_was_killed_completes_what_was_heard() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(ENV_SERVER, seq=3, counters={"ticks": 90, "missed": 2}, returns=[episode(0, 1.0)]), 1)
    watch.feed_final(
        [
            ledger(ENV_SERVER, seq=0, final=False, counters={"ticks": 100, "missed": 1}),
            ledger(LEARNER, seq=0, final=False, counters={"learned": 4}),  # died before its first message
        ]
    )
    (killed,) = watch.stats()[ENV_SERVER]
    assert killed.counters == {"ticks": 100, "missed": 2}
    assert [one.value for one in killed.returns] == [1.0]
    assert watch.totals(LEARNER).counters["learned"] == 4


def happening(what: What, process: str = LEARNER) -> Happening:
    return Happening(5, process, what, None if what == "restarted" else -9, f"{process} {what}")


def test_between_two_lives_nothing_is_known_of_a_process() -> None:
    watch = Watch(100.0)
    for seq in range(3):
        watch.feed(ledger(LEARNER, seq=seq, at_ns=seq * SECOND // 4, counters={"learned": seq}), SECOND)
    watch.happened(happening("died"))
    assert watch.down == {LEARNER}
    assert not watch.heard(LEARNER)
    assert watch.health(LEARNER, SECOND) == "missing"
    assert watch.rate(LEARNER, "learned") is None
    assert watch.totals(LEARNER).counters["learned"] == 2
    watch.happened(happening("restarted"))
    watch.happened(happening("stuck", ENV_SERVER))
    assert (watch.down, watch.restarts) == ({ENV_SERVER}, {LEARNER: 1})
    assert [one.what for one in watch.happenings] == ["died", "restarted", "stuck"]


def test_who_starves_lives() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(LEARNER, counters={"learned": 7}), SECOND)
    watch.happened(happening("starved"))
    assert watch.heard(LEARNER)
    assert (watch.down, watch.restarts) == (set(), {})
    assert [one.what for one in watch.happenings] == ["starved"]


def test_the_phase_is_that_of_the_newest_life_that_knows_one() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(LEARNER, incarnation=1, windows=[notice(3, "hold")]), 1)
    watch.feed(ledger(LEARNER, incarnation=2), 2)
    phase = watch.phase()
    assert phase is not None and phase.window == 3


def test_the_lives_of_strangers_are_bounded() -> None:
    watch = Watch(100.0)
    watch.feed(ledger(ENV_SERVER, incarnation=1, counters={"ticks": 5}), 0)
    for incarnation in range(2, 1200):
        watch.feed(ledger(ENV_SERVER, incarnation=incarnation, counters={"ticks": 0}), 0)
    watch.feed(ledger(ENV_SERVER, incarnation=1, seq=1, counters={"ticks": 6}), 0)
    assert watch.refused == 199
    assert watch.totals(ENV_SERVER).counters["ticks"] == 6


def fleet_of(count: int) -> Watch:
    """Env servers that tick at 10 (i + 1) Hz for two seconds, with one episode each, last comers first."""
    watch = Watch(100.0)
    for index in reversed(range(count)):
        for quarter in range(9):
            stats = ledger(
                f"env_server.{index}",
                seq=quarter,
                at_ns=quarter * SECOND // 4,
                counters={"ticks": 5 * quarter * (index + 1), "produced": 1},
                histograms={"loop": [1000 * (index + 1)]},
                returns=[episode(0, float(index))],
            )
            watch.feed(stats, stats.at_ns)
    return watch


def test_a_roles_rates_and_totals_are_those_of_its_processes_together() -> None:
    watch = fleet_of(3)
    assert watch.rate("env_server.1", "ticks") == 40.0
    assert watch.rate(ENV_SERVER, "ticks") == 20.0 + 40.0 + 60.0
    assert watch.totals("env_server.1").counters["ticks"] == 80
    total = watch.totals(ENV_SERVER)
    assert total.counters == {"ticks": 40 + 80 + 120, "produced": 3}
    assert total.histograms["loop"].count == 3
    assert watch.totals("env_server.1").histograms["loop"].count == 1  # putting together changes no part
    assert watch.totals("env_server").histograms["loop"].count == 3


def test_returns_are_in_the_environments_order() -> None:
    assert fleet_of(12).totals(ENV_SERVER).returns == [float(index) for index in range(12)]  # 9, 10, 11


def test_who_died_is_out_of_the_roles_rate() -> None:
    watch = fleet_of(2)
    watch.happened(happening("died", "env_server.1"))
    assert watch.rate(ENV_SERVER, "ticks") == 20.0
    assert watch.down == {"env_server.1"}
    assert watch.heard("env_server.0") and not watch.heard("env_server.1")
    assert watch.totals(ENV_SERVER).counters["ticks"] == 40 + 80


def test_who_has_ended_is_out_of_it_while_others_go_on() -> None:
    watch = fleet_of(2)
    for index, left in ((1, 20.0), (0, 20.0 + 40.0)):  # the last rates stay when all have ended
        last = ledger(f"env_server.{index}", seq=9, at_ns=2 * SECOND, final=True,
                      counters={"ticks": 40 * (index + 1)})  # fmt: skip
        watch.feed(last, 2 * SECOND)
        assert watch.rate(ENV_SERVER, "ticks") == left
