from __future__ import annotations

from launcher.vitals import PATIENCE, START_NS, Vitals
from rtcore.channels import AGENT, ENV_SERVER, LAUNCHER, LEARNER
from rtcore.messages import Stats
from tests.launcher.ledgers import ledger

SECOND = 1_000_000_000
LOOK = SECOND // 20


class Watched:
    """Vitals with a limit of 2 s in a life of looks, 20 a second; who beats is heard at each."""

    def __init__(self) -> None:
        self.vitals = Vitals(2.0)
        self.now_ns = 1000 * SECOND
        self.vitals.look(self.now_ns)

    def look(self, *beating: str, seconds: float, incarnation: int = 1) -> list[str]:
        """So many seconds of looks; who was found stuck at the last."""
        found: list[str] = []
        for _ in range(round(seconds * 20)):
            self.now_ns += LOOK
            for process in beating:
                self.hear(said(process, self.now_ns, incarnation))
            self.vitals.look(self.now_ns)
            found = self.vitals.stuck()
        return found

    def hear(self, stats: Stats) -> None:
        self.vitals.heard(stats, self.now_ns)


def said(process: str, beat_ns: int, incarnation: int = 1) -> Stats:
    return ledger(process, incarnation=incarnation, beat_ns=beat_ns)


def test_whose_loop_does_not_turn_is_stuck_though_his_threads_speak() -> None:
    watched = Watched()
    for process in (ENV_SERVER, AGENT):
        watched.vitals.started(process)
    assert watched.look(ENV_SERVER, AGENT, seconds=5) == []
    frozen = said(AGENT, watched.now_ns)
    # It was heard one look before the last; 39 more, in which it says the same again and again, make 2 s.
    for _ in range(39):
        watched.hear(frozen)
        assert watched.look(ENV_SERVER, seconds=0.05) == []
    watched.hear(frozen)
    assert watched.look(ENV_SERVER, seconds=0.05) == [AGENT]
    assert watched.vitals.silent_ns(AGENT) == 41 * LOOK


def test_a_start_has_its_time() -> None:
    watched = Watched()
    watched.vitals.started(ENV_SERVER)
    watched.vitals.started(LEARNER)
    seconds = START_NS / SECOND
    watched.look(ENV_SERVER, seconds=0.05)  # from here on the launcher hears somebody
    assert watched.look(ENV_SERVER, seconds=seconds - 1) == []
    assert watched.look(ENV_SERVER, seconds=2) == [LEARNER]


def test_the_launchers_own_stall_is_held_against_nobody() -> None:
    watched = Watched()
    watched.vitals.started(AGENT)
    watched.vitals.started(LEARNER)
    watched.look(AGENT, LEARNER, seconds=1)
    watched.now_ns += 100 * SECOND  # the machine slept; both go on, the learner a second later
    assert watched.look(AGENT, seconds=1) == []
    assert watched.look(AGENT, LEARNER, seconds=1) == []


def test_a_launcher_that_hears_nobody_judges_nobody() -> None:
    watched = Watched()
    for process in (AGENT, LEARNER):
        watched.vitals.started(process)
    watched.look(AGENT, LEARNER, seconds=1)
    assert watched.look(LAUNCHER, seconds=100) == []  # what it says itself is no sign of hearing
    assert watched.look(AGENT, seconds=0.9) == []  # with the second that deafness took to show: 1.95 s
    assert watched.look(AGENT, seconds=0.1) == [LEARNER]


def test_a_later_life_is_judged_by_its_own_words() -> None:
    watched = Watched()
    watched.vitals.started(AGENT)
    watched.vitals.started(ENV_SERVER)
    watched.look(AGENT, ENV_SERVER, seconds=1)
    watched.look(ENV_SERVER, seconds=3)
    watched.vitals.gone(AGENT)
    assert watched.look(ENV_SERVER, seconds=3) == []  # between two lives nothing is expected
    watched.vitals.started(AGENT)
    watched.hear(said(AGENT, watched.now_ns))  # last words of the earlier life do not end the start's time
    assert watched.look(ENV_SERVER, seconds=5) == []
    assert watched.look(AGENT, ENV_SERVER, seconds=1, incarnation=2) == []
    assert watched.look(ENV_SERVER, seconds=3, incarnation=2) == [AGENT]


def test_each_process_of_a_fleet_is_watched_for_itself() -> None:
    watched = Watched()
    first, second = "agent_service.0", "agent_service.1"
    for process in (first, second):
        watched.vitals.started(process)
    assert watched.look(first, second, seconds=1) == []
    assert watched.look(first, seconds=2.5) == [second]
    watched.vitals.gone(second)
    assert watched.look(first, seconds=5) == []


def starved(process: str, seconds: float, watched: Watched, share: float = 1.0) -> list[str]:
    """So many seconds of looks, of each of which the process waited for a core for a share; who is stuck."""
    found: list[str] = []
    for _ in range(round(seconds * 20)):
        watched.look(ENV_SERVER, seconds=0.05)
        if process in watched.vitals.silent():
            watched.vitals.excuse(process, round(share * LOOK))
        found = watched.vitals.stuck()
    return found


def test_what_is_excused_is_not_held_against_it() -> None:
    watched = Watched()
    for process in (ENV_SERVER, LEARNER):
        watched.vitals.started(process)
    watched.look(ENV_SERVER, LEARNER, seconds=1)
    # After k looks it has been silent for k + 1, and half of each is excused from the 20th on: at k = 59 that
    # leaves 60 - 40 / 2 = 40, the limit.
    assert starved(LEARNER, 2.95, watched, share=0.5) == []
    assert starved(LEARNER, 0.05, watched, share=0.5) == [LEARNER]


def test_who_starves_is_told_once_in_a_silence() -> None:
    watched = Watched()
    for process in (ENV_SERVER, LEARNER):
        watched.vitals.started(process)
    for _ in range(2):
        watched.look(ENV_SERVER, LEARNER, seconds=1)
        assert starved(LEARNER, 1.95, watched) == []
        assert watched.vitals.starving() == []  # 2 s are allowed
        assert starved(LEARNER, 0.05, watched) == []
        assert watched.vitals.starving() == [LEARNER]
        assert starved(LEARNER, 3.0, watched) == []
        assert watched.vitals.starving() == []  # it has been told


def test_who_waited_for_a_moment_does_not_starve() -> None:
    watched = Watched()
    for process in (ENV_SERVER, LEARNER):
        watched.vitals.started(process)
    watched.look(ENV_SERVER, LEARNER, seconds=1)
    assert starved(LEARNER, 1.95, watched, share=0.45) == []  # 20 looks: 0.45 s of the limit of 2 s
    assert starved(LEARNER, 0.05, watched, share=0.45) == []
    assert watched.vitals.silent_ns(LEARNER) > 2 * SECOND
    assert watched.vitals.starving() == []
    assert starved(LEARNER, 0.10, watched, share=0.45) == []
    assert watched.vitals.starving() == [LEARNER]  # 0.52 s are more than a quarter


def test_patience_has_an_end() -> None:
    watched = Watched()
    for process in (ENV_SERVER, LEARNER):
        watched.vitals.started(process)
    watched.look(ENV_SERVER, LEARNER, seconds=1)
    assert starved(LEARNER, 2.0 * PATIENCE - 0.05, watched) == []
    assert starved(LEARNER, 0.05, watched) == [LEARNER]
    assert watched.vitals.starving() == []


def test_no_more_is_excused_than_has_passed_for_the_launcher() -> None:
    watched = Watched()
    for process in (ENV_SERVER, LEARNER):
        watched.vitals.started(process)
    watched.look(ENV_SERVER, LEARNER, seconds=1)
    watched.look(ENV_SERVER, seconds=1.5)
    watched.vitals.excuse(LEARNER, 100 * SECOND)  # one look: 50 ms
    assert watched.look(ENV_SERVER, seconds=0.5) == []
    assert watched.look(ENV_SERVER, seconds=0.05) == [LEARNER]
