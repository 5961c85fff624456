"""Which observations are still worth an answer: hand-made stamps at 1 kHz."""

from __future__ import annotations

from agent_service.freshness import MEMORY, OLD_IN_A_ROW, Freshness

MS = 1_000_000


def test_behind_a_stall_all_but_the_newest_are_old() -> None:
    freshness = Freshness(MS)
    assert not freshness.is_old(0, 100_000)
    # The ways of 50 observations that wait for 50 ms end at the same instant, the shortest last.
    old = [freshness.is_old(tick * MS, 51 * MS + 100_000) for tick in range(1, 52)]
    assert old == [True] * 48 + [False] * 3  # excess 50 .. 3 ms; exactly 2 ms, 1 ms and 0 are answered


def test_the_clocks_may_be_those_of_two_hosts() -> None:
    for offset in (-(10**15), 10**15):
        freshness = Freshness(MS)
        ways = enumerate((5, 0, 2 * MS))
        assert [freshness.is_old(k * MS, k * MS + offset + way) for k, way in ways] == [
            False, False, False,
        ]  # fmt: skip
        assert freshness.is_old(9 * MS, 11 * MS + offset + 1)


def test_what_was_the_shortest_way_is_forgotten() -> None:
    """Clocks that drift apart by 900 ppm make every way longer: 4.5 ticks in 5000; none of them is old."""
    freshness = Freshness(MS)
    assert not any(freshness.is_old(k * MS, k * MS + k * 900) for k in range(5 * MEMORY))


def test_a_clock_that_was_set_is_believed_in_the_end() -> None:
    freshness = Freshness(MS)
    freshness.is_old(0, 0)
    later = [freshness.is_old(k * MS, k * MS + 5_000 * MS) for k in range(1, 301)]
    assert later == [True] * OLD_IN_A_ROW + [False] * (300 - OLD_IN_A_ROW)
