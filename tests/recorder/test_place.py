"""What survives a kill -9 in a few kilobytes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from recorder.place import SLOT_BYTES, Carried, EnvPlace, Kept, Place, PlaceFile, Told
from recorder.rows import EPISODES, Timeline
from recorder.seen import EVENTS_KEPT, KEPT, MARKED, STATS_KEPT, STATS_MARKED, Seen
from recorder.telemetry import TelemetryRows
from rtcore.messages import Event
from tests.recorder.stage import SPEC, T0, TICK, make_stats, make_step


def kept(length: int) -> Kept:
    return Kept(inode=7, length=length, place=Place({"env0": EnvPlace((3, length))}))


def test_the_newest_place_is_found_whole(tmp_path: Path) -> None:
    path = tmp_path / "place"
    assert PlaceFile(path).read() is None
    for life in range(3):  # each goes on where the last one ended
        file = PlaceFile(path)
        file.read()
        for length in range(3):
            file.keep(kept(10 * life + length))
        file.close()
        found = PlaceFile(path).read()
        assert found == kept(10 * life + 2)
    assert path.stat().st_size == 2 * SLOT_BYTES


@pytest.mark.parametrize("torn_at", [0, 5, 16, 20])
def test_a_torn_place_leaves_the_one_before(tmp_path: Path, torn_at: int) -> None:
    path = tmp_path / "place"
    file = PlaceFile(path)
    for length in (1, 2, 3):
        file.keep(kept(length))
    data = bytearray(path.read_bytes())
    offset = SLOT_BYTES  # generation 3 is in the second slot
    data[offset + torn_at] ^= 0x55
    path.write_bytes(data)
    assert PlaceFile(path).read() == kept(2)
    path.write_bytes(data[: offset + 3])
    assert PlaceFile(path).read() == kept(2)
    path.write_bytes(b"")
    assert PlaceFile(path).read() is None


def test_everything_in_a_place_comes_back(tmp_path: Path) -> None:
    seen = Seen()
    assert seen.add(5, 1)
    told = Told({"learner": seen.mark()}, {}, seen.mark(), forecast_names=["a"])
    own = EnvPlace((1 << 62, 9), Carried(2, 8, math.nan, None), [(4, -5)])
    place = Place({"env0": own, "env1": EnvPlace()}, {"learner": "SCHED_OTHER"}, told)
    file = PlaceFile(tmp_path / "place")
    file.keep(Kept(1, 2, place))
    found = file.read()
    assert found is not None
    carried = found.place.envs["env0"].carried
    assert carried is not None
    assert math.isnan(carried.first)
    assert (found.place.envs["env0"].log, found.place.envs["env0"].episodes) == (own.log, own.episodes)
    assert found.place.envs["env1"] == EnvPlace()
    assert (found.place.placements, found.place.told) == (place.placements, told)


def test_the_fullest_place_that_five_processes_can_make_fits(tmp_path: Path) -> None:
    seen = Seen()
    for at in range(KEPT):
        seen.add((1 << 62) + at, (1 << 32) - 1)
    marks = {f"process_{i}": seen.mark() for i in range(5)}
    file = PlaceFile(tmp_path / "place")
    file.keep(Kept(1 << 40, 1 << 40, Place(told=Told(events=marks, notices=seen.mark()))))
    with pytest.raises(OSError, match="are too many for a place"):
        file.keep(Kept(1, 2, Place(placements={"learner": "x" * SLOT_BYTES})))
    assert file.read() is not None
    file.close()


def test_what_was_seen_is_told_from_what_is_new() -> None:
    seen = Seen()
    assert seen.add(-5, 0)
    assert seen.add(-5, 1)  # another one of the same stamp
    assert not seen.add(-5, 0)
    again = Seen(seen.mark())
    assert not again.add(-5, 1)
    assert again.add(-6, 0)  # older, but new


def test_memory_is_bounded_and_what_is_older_than_it_counts_as_seen() -> None:
    seen = Seen()
    assert all(seen.add(at, 0) for at in range(5 * KEPT))
    assert len(seen._items) < 2 * KEPT
    assert not any(seen.add(at, 0) for at in range(5 * KEPT))
    mark = seen.mark()
    assert (len(mark.items), mark.floor_ns) == (MARKED, 5 * KEPT - MARKED - 1)
    again = Seen(mark)
    assert not any(again.add(at, 0) for at in range(5 * KEPT))
    assert again.add(5 * KEPT, 0)


def test_the_fullest_place_of_a_fleet_fits(tmp_path: Path) -> None:
    seen, few = Seen(), Seen(kept=STATS_KEPT, marked=STATS_MARKED)
    for at in range(KEPT):
        seen.add((1 << 62) + at, (1 << 32) - 1)
        few.add((1 << 62) + at, (1 << 32) - 1)
    marks = {f"agent_service.{i}": seen.mark() for i in range(35)}  # 16 pairs, and three more
    stats = {process: few.mark() for process in marks}
    episode = (1 << 40, 1 << 62)
    own = EnvPlace((1 << 62, 1 << 40), Carried(1 << 62, 1 << 40, 0.5, 0.5), [episode] * EPISODES)
    envs = {f"env{i}": own for i in range(16)}
    told = Told(stats, marks, seen.mark(), seen.mark())
    kept_whole = Kept(1 << 40, 1 << 40, Place(envs, dict.fromkeys(marks, "x" * 100), told))
    file = PlaceFile(tmp_path / "place", 16)
    file.keep(kept_whole)
    assert file.read() == kept_whole
    file.close()
    assert PlaceFile(tmp_path / "place", 16).read() == kept_whole


def test_of_what_repeats_little_little_is_remembered() -> None:
    telemetry = TelemetryRows()
    sizes = set()
    for seq in range(5_000):
        events = [Event(at_ns=seq, level="INFO", text="x")]
        telemetry.stats(make_stats("agent_service.3", seq, seq, events=events))
        telemetry.rows(Timeline(SPEC))
        seen = [*telemetry._stats_seen.values(), *telemetry._events_seen.values()]
        sizes.add(max(len(one._items) for one in seen))
    assert max(sizes) <= 2 * EVENTS_KEPT
    assert len(telemetry._stats_seen["agent_service.3"]._items) <= 2 * STATS_KEPT
    assert len(telemetry.told.stats["agent_service.3"].items) == STATS_MARKED
    assert len(telemetry.told.events["agent_service.3"].items) == MARKED


def test_episodes_are_remembered_as_long_as_they_may_be_asked_for() -> None:
    timeline = Timeline(SPEC)
    for seq in range(0, 50_000, 10):
        timeline.remember([make_step(seq)])
    assert len(timeline._episodes) == len(timeline._episode_starts_ns) <= 2 * EPISODES
    asked = [T0 + seq * TICK for seq in range(49_990 - 10 * (EPISODES - 1), 50_000, 10)]
    assert timeline.of_stamps(asked).episode.tolist() == list(range(5_000 - EPISODES, 5_000))
