"""How a life of the env server begins: whom it waits for, and where in the run it is.

The first life sets T0. A later one goes on by it: at the tick that is due now, in the unit that it is now,
with episodes that nobody has seen; the deadlines in between have passed, and are counted as `down`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from env_server.worlds.period import num_ticks
from rtcore import cast, channels, epoch
from rtcore.bus import Bus
from rtcore.cast import Part
from rtcore.clock import Clock
from rtcore.config import RunConfig
from rtcore.epoch import Epoch
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.run_dir import RunDir

LEAD_NS = 100_000_000  # from announcing to the first tick, so that the spec is with everybody before step 0
# The env servers of a fleet see each other come within a poll: who proposes T0 leaves the others the time.
FLEET_LEAD_NS = 300_000_000
PEERS_POLL_S = 0.05
# A later life finds the run's clock running: it waits as long as links need to come back, 1.2 s at worst.
RETURN_WAIT_S = 1.2
ALONE = Part(channels.ENV_SERVER)


@dataclass(frozen=True, slots=True)
class Past:
    """Where a life learns of those before it.

    Attributes:
        run_dir: what they left; None: there are none, and none will follow.
        wall_ns: Unix time.
        part: which env server of the run this is.
    """

    run_dir: RunDir | None = None
    wall_ns: Callable[[], int] = time.time_ns
    part: Part = ALONE


@dataclass(frozen=True, slots=True)
class Beginning:
    """Where a life is in the run.

    Attributes:
        epoch: when the run began, on this boot's clock.
        first_index: the life's first tick.
        end_index: the tick after the run's last; None: it ends when stopped.
        first_episode: the number of the life's first episode.
        down: deadlines that passed while no env server lived, since the life before.
    """

    epoch: Epoch
    first_index: int
    end_index: int | None
    first_episode: int = 0
    down: int = 0


def wait_for_peers(config: RunConfig, past: Past, bus: Bus, clock: Clock, ledger: Ledger, stop: Stop) -> None:
    """Wait until all other processes of the run are there: whoever comes later finds only the newest policy.
    `env.start_wait_s` at most, and where the run has begun already 1.2 s.
    """
    wait_s, returns = config.env.start_wait_s, _has_begun(past)
    if returns:
        wait_s = min(wait_s, RETURN_WAIT_S)
    peers = {*cast.names(config, record=config.recorder.record)} - {past.part.name}
    limit_ns = clock.now_ns() + round(wait_s * 1e9)
    while missing := peers - bus.alive():
        now_ns = clock.now_ns()
        ledger.beat(now_ns)
        if now_ns >= limit_ns:
            names = " and ".join(sorted(missing))
            ledger.event(now_ns, "WARN", f"starting without {names} after {wait_s:g} s")
            return
        if not returns and _has_begun(past):  # another env server has waited long enough: T0 is set
            return
        if stop.wait(min(PEERS_POLL_S, (limit_ns - now_ns) / 1e9)):
            return


def _has_begun(past: Past) -> bool:
    return past.run_dir is not None and epoch.read(past.run_dir.epoch_path) is not None


def begin(config: RunConfig, past: Past, clock: Clock, ledger: Ledger, *, tick_ns: int) -> Beginning:
    """Find out where in the run this life begins.

    Raises:
        ConfigError: the run's beginning cannot be read.
    """
    end_index = num_ticks(config.env, config.duration_s) or None
    run_dir, now_ns, unix_ns = past.run_dir, clock.now_ns(), past.wall_ns()
    boot_id = "" if run_dir is None else epoch.this_boot()
    process, alone = past.part.name, past.part.index is None
    lead_ns = LEAD_NS if alone else FLEET_LEAD_NS
    proposed = Epoch(t0_ns=now_ns + lead_ns, wall_t0_ns=unix_ns + lead_ns, boot_id=boot_id)
    if run_dir is None:
        return Beginning(shifted(proposed, config, past.part, tick_ns), 0, end_index)
    if not alone:  # T0 is one for all
        agreed, problem = epoch.agree(run_dir.epoch_path, proposed, now_ns=now_ns, wall_ns=unix_ns)
        if problem is not None:
            text = f"T0 is not on disk ({problem}): this environment goes by one of its own"
            ledger.event(now_ns, "ERROR", text)
        proposed = shifted(agreed, config, past.part, tick_ns)
    settled, problem = epoch.settle(run_dir.lives_path(process), proposed, now_ns=now_ns, wall_ns=unix_ns)
    if problem is not None:
        text = f"the run's beginning is not on disk ({problem}): a later env server would begin anew"
        ledger.event(now_ns, "WARN", text)
    # Of a fleet another one may have set T0 long ago, and written files may have taken long.
    if settled.lives == 1 and (alone or clock.now_ns() < settled.t0_ns):
        return Beginning(settled, 0, end_index)
    lives = [stats.counters for stats in run_dir.read_final_stats() if stats.process == process]
    return go_on(settled, lives, now_ns=clock.now_ns(), tick_ns=tick_ns, end_index=end_index)


def shifted(agreed: Epoch, config: RunConfig, part: Part, tick_ns: int) -> Epoch:
    """The beginning as this environment of a fleet keeps it."""
    offset_ns = cast.offset_ns(part.number, config.env.count, tick_ns)
    return replace(agreed, t0_ns=agreed.t0_ns + offset_ns, wall_t0_ns=agreed.wall_t0_ns + offset_ns)


def go_on(
    settled: Epoch, lives: Sequence[Mapping[str, int]], *, now_ns: int, tick_ns: int, end_index: int | None
) -> Beginning:
    """Where a life begins that finds the run begun: at the first deadline at or after `now_ns` and the lead.
    Pure.

    Args:
        settled: when the run began.
        lives: the counters of the earlier lives; those that began have `lives` = 1.
        now_ns: the present.
        tick_ns: the control period.
        end_index: see `Beginning`.
    """
    first_index = max(0, -(-(now_ns + LEAD_NS - settled.t0_ns) // tick_ns))
    if end_index is not None:
        first_index = min(first_index, end_index)
    begun = [counters for counters in lives if counters.get("lives", 0)]
    accounted = sum(counters.get(name, 0) for counters in begun for name in ("ticks", "skipped", "down"))
    episodes = sum(counters.get("resets", 0) for counters in begun)
    # A life of which nothing is left had no more episodes than ticks, so these are nobody's either.
    first_episode = episodes if len(begun) >= settled.lives - 1 else first_index
    return Beginning(settled, first_index, end_index, first_episode, max(0, first_index - accounted))
