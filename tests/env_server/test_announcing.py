"""Where in the run a life of the env server begins."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from env_server.announcing import LEAD_NS, RETURN_WAIT_S, Beginning, Past, begin, go_on, wait_for_peers
from env_server.service import EnvService
from env_server.worlds.registry import resolve
from rtcore import cast, channels
from rtcore.cast import Part
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.epoch import Epoch, read
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Spec, Step
from rtcore.run_dir import RunDir
from rtcore.tally import Tally
from tests.env_server.rig import START_NS, TICK_NS, run_config
from tests.env_server.scripted import ScriptedWorld

MS = 1_000_000
WALL_NS = 7_000_000_000


def epoch(lives: int = 2, t0_ns: int = 1_000 * MS) -> Epoch:
    return Epoch(t0_ns=t0_ns, wall_t0_ns=0, boot_id="", lives=lives)


def life(ticks: int, resets: int, skipped: int = 0, down: int = 0) -> dict[str, int]:
    return {"lives": 1, "ticks": ticks, "resets": resets, "skipped": skipped, "down": down}


def test_a_later_life_begins_at_the_tick_that_is_due() -> None:
    """T0 at 1 s, 10 ms ticks, now 2.003 s: with the lead of 100 ms the next deadline is 2.11 s, tick 111. The
    lives before did 40 + 2 ticks, then missed 8 and did 10 of them: 111 - 60 = 51 are down. They began 5 + 2
    episodes, so the next is number 7."""
    settled = epoch(lives=3)
    found = go_on(
        settled, [life(40, 5, skipped=2), {"lives": 0}, life(10, 2, down=8)], now_ns=2_003 * MS,
        tick_ns=TICK_NS, end_index=200,
    )  # fmt: skip
    assert found == Beginning(settled, 111, 200, first_episode=7, down=51)


def test_exactly_on_a_deadline_it_is_that_tick() -> None:
    assert go_on(epoch(), [], now_ns=2_000 * MS, tick_ns=TICK_NS, end_index=None).first_index == 110


def test_after_the_end_nothing_is_left_but_what_was_missed() -> None:
    found = go_on(epoch(), [life(40, 5)], now_ns=9_000 * MS, tick_ns=TICK_NS, end_index=200)
    assert (found.first_index, found.end_index, found.down) == (200, 200, 160)


def test_before_t0_it_is_tick_0() -> None:
    found = go_on(epoch(), [life(0, 0)], now_ns=850 * MS, tick_ns=TICK_NS, end_index=200)
    assert (found.first_index, found.down, found.first_episode) == (0, 0, 0)


def test_a_life_of_which_nothing_is_left_shares_no_episode() -> None:
    found = go_on(epoch(lives=3), [life(40, 5)], now_ns=2_000 * MS, tick_ns=TICK_NS, end_index=None)
    assert found.first_episode == found.first_index == 110


def test_with_one_life_only_t0_is_ahead_and_nothing_is_written() -> None:
    clock, ledger = VirtualClock(START_NS), Ledger("env_server", 1)
    found = begin(run_config(), Past(wall_ns=lambda: WALL_NS), clock, ledger, tick_ns=TICK_NS)
    t0_ns, wall_t0_ns = START_NS + LEAD_NS, WALL_NS + LEAD_NS
    assert found == Beginning(Epoch(t0_ns=t0_ns, wall_t0_ns=wall_t0_ns, boot_id=""), 0, 100)


class Lives:
    """The lives of one run's env server, one after the other, on one virtual clock."""

    def __init__(self, path: Path, config: RunConfig) -> None:
        self.config = replace(config, env=resolve(config.env))
        self.run_dir = RunDir.create(path / "run", self.config)
        self.clock = VirtualClock(START_NS)
        self.hub = MemoryHub()
        reader = self.hub.bus("reader", self.clock)
        self.specs, self.steps = reader.queue(channels.SPEC, "*"), reader.queue(channels.STEP, "*")

    def live(self, most_ticks: int, *, down_s: float = 0.0) -> tuple[list[Step], Spec, Ledger, ScriptedWorld]:
        """A life that is killed after so many ticks, or ends; then nobody lives for `down_s`."""
        name, world = channels.ENV_SERVER, ScriptedWorld()
        incarnation = self.run_dir.next_incarnation(name, 5)
        with Tally.create(self.run_dir.tally_path(name, incarnation)) as tally:
            ledger = Ledger(name, incarnation, tally)
            bus = self.hub.bus(name, self.clock)
            past = Past(self.run_dir, lambda: WALL_NS)
            service = EnvService(self.config, world, bus, self.clock, ledger, incarnation, past=past)
            service.announce()
            for tick in service.pacer.ticks(Stop()):
                service.step(tick)
                if service.pacer.executed == most_ticks:
                    break
            bus.close()
        self.clock.advance_ns(round(down_s * 1e9))
        (spec,) = [received.message for received in self.specs.drain()]
        return [received.message for received in self.steps.drain()], spec, ledger, world


def test_lives_share_a_clock_a_drift_and_an_end(tmp_path: Path) -> None:
    """1 s at 100 Hz, units of 0.1 s, episodes of a reset and 9 steps. Killed after 25 ticks; nobody lives for
    0.3 s, and 0.1 s are the lead. So the second life begins 0.24 + 0.3 + 0.1 s after T0, at tick 64."""
    lives = Lives(tmp_path, run_config())
    first, spec, ledger, world = lives.live(25, down_s=0.3)
    assert [step.tick for step in first] == list(range(25))
    assert (ledger.counter("down"), ledger.counter("lives")) == (0, 1)
    second, later_spec, later, later_world = lives.live(1000)
    assert [step.tick for step in second] == list(range(64, 100))
    assert [step.seq for step in second] == list(range(36))
    assert [step.unit for step in second] == [step.tick // 10 for step in second]
    assert [step.drift for step in second] == [10.0 * step.unit for step in second]
    assert [step.due_ns for step in second] == [spec.t0_ns + tick * TICK_NS for tick in range(64, 100)]
    assert (later_spec.t0_ns, later_spec.wall_t0_ns) == (spec.t0_ns, spec.wall_t0_ns)
    assert later_spec.host == spec.host != ""
    assert later_spec.incarnation > spec.incarnation
    assert later.counter("down") == 64 - 25
    assert ledger.counter("ticks") + later.counter("ticks") + later.counter("down") == 100
    assert [first[-1].episode, second[0].episode] == [2, 3]
    assert not set(world.seeds) & set(later_world.seeds)
    known = read(lives.run_dir.epoch_path)
    assert known is not None and known.lives == 2


class Ticking(Stop):
    """Whose waits take virtual time."""

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__()
        self._clock = clock

    def wait(self, timeout_s: float) -> bool:
        self._clock.advance_ns(round(timeout_s * 1e9))
        return False


def test_a_fleet_has_one_t0_and_whoever_comes_late_begins_at_the_present_tick(tmp_path: Path) -> None:
    """T0 is 0.3 s after the first one proposes it. The second is there 0.15 s later: 0.15 s before T0, more
    than the lead, so it begins at tick 0. The third comes 0.5 s after the first: 0.2 s of run time and a lead
    of 0.1 s, so tick 30 of 100 Hz. Its second life has lives of its own. The deadlines of all are spread over
    a period."""
    clock, config = VirtualClock(START_NS), run_config(count=3)
    run_dir, ledger = RunDir.create(tmp_path / "run", config), Ledger("env_server.0", 1)

    def beginning(index: int) -> Beginning:
        past = Past(run_dir, lambda: WALL_NS, Part(channels.ENV_SERVER, index))
        return begin(config, past, clock, ledger, tick_ns=TICK_NS)

    first = beginning(0)
    clock.advance_ns(150 * MS)
    second = beginning(1)
    clock.advance_ns(350 * MS)
    third = beginning(2)
    again = beginning(2)
    t0_ns = START_NS + 300 * MS
    assert [one.epoch.t0_ns for one in (first, second, third, again)] == [
        t0_ns, t0_ns + TICK_NS // 3, t0_ns + 2 * TICK_NS // 3, t0_ns + 2 * TICK_NS // 3,
    ]  # fmt: skip
    assert [one.first_index for one in (first, second, third)] == [0, 0, 30]
    assert [one.down for one in (first, second, third)] == [0, 0, 30]
    assert [one.epoch.lives for one in (first, second, third, again)] == [1, 1, 1, 2]
    assert {one.end_index for one in (first, second, third)} == {100}


def test_a_fleet_waits_for_everybody_but_itself(tmp_path: Path) -> None:
    clock, config = VirtualClock(START_NS), run_config(count=2, start_wait_s=15.0)
    hub, past = MemoryHub(), Past(part=Part(channels.ENV_SERVER, 1))
    missing, ledger = "agent_service.0", Ledger("env_server.1", 1)
    bus = hub.bus("env_server.1", clock)
    for name in cast.names(config):
        if name not in (missing, past.part.name):
            hub.bus(name, clock).declare_alive(name)
    wait_for_peers(config, past, bus, clock, ledger, Ticking(clock))
    assert clock.now_ns() - START_NS == 15_000 * MS
    (event,) = ledger.stats(1).events
    assert event.text == "starting without agent_service.0 after 15 s"
    hub.bus(missing, clock).declare_alive(missing)
    wait_for_peers(config, past, bus, clock, ledger, Ticking(clock))
    assert clock.now_ns() - START_NS == 15_000 * MS


def test_a_fleet_begins_together_though_somebody_is_missing(tmp_path: Path) -> None:
    """The recorder never comes. The first env server gives up after 15 s; the second, which came a second
    later, then waits no longer, and begins at tick 0 as well."""
    config = run_config(count=2, start_wait_s=15.0)
    run_dir, clock = RunDir.create(tmp_path / "run", config), VirtualClock(START_NS)
    pasts = [Past(run_dir, lambda: WALL_NS, Part(channels.ENV_SERVER, index)) for index in (0, 1)]
    ledger = Ledger("env_server.1", 1)

    class Waiting(Ticking):
        def wait(self, timeout_s: float) -> bool:
            if self._clock.now_ns() >= START_NS + 14_000 * MS and not run_dir.epoch_path.exists():
                begin(config, pasts[0], clock, Ledger("env_server.0", 1), tick_ns=TICK_NS)
            return super().wait(timeout_s)

    bus = MemoryHub().bus("env_server.1", clock)
    wait_for_peers(config, pasts[1], bus, clock, ledger, Waiting(clock))
    assert clock.now_ns() - START_NS < 14_200 * MS
    found = begin(config, pasts[1], clock, ledger, tick_ns=TICK_NS)
    assert (found.first_index, found.down) == (0, 0)


def test_a_life_after_the_end_does_not_tick(tmp_path: Path) -> None:
    lives = Lives(tmp_path, run_config())
    lives.live(25, down_s=5.0)
    steps, _, ledger, _ = lives.live(1000)
    assert steps == []
    assert ledger.counter("down") == 75


@pytest.mark.parametrize(("begun", "waited_s"), [(False, 15.0), (True, RETURN_WAIT_S)])
def test_where_the_run_has_begun_nobody_is_waited_for_long(
    tmp_path: Path, begun: bool, waited_s: float
) -> None:
    clock = VirtualClock(START_NS)
    ledger = Ledger("env_server", 1)

    config = run_config(start_wait_s=15.0)
    run_dir = RunDir.create(tmp_path / "run", config)
    if begun:
        begin(config, Past(run_dir), clock, ledger, tick_ns=TICK_NS)
    wait_for_peers(config, Past(run_dir), MemoryHub().bus("env", clock), clock, ledger, Ticking(clock))
    assert clock.now_ns() - START_NS == round(waited_s * 1e9)
    assert ledger.stats(1).beat_ns == clock.now_ns()
