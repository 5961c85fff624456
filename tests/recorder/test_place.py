"""What survives a kill -9 in a few kilobytes."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from recorder.place import SLOT_BYTES, Carried, Kept, Place, PlaceFile, Told
from recorder.seen import KEPT, MARKED, Seen


def kept(length: int) -> Kept:
    return Kept(inode=7, length=length, place=Place(log=(3, length)))


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
    place = Place((1 << 62, 9), Carried(2, 8, math.nan, None), [(4, -5)], {"learner": "SCHED_OTHER"}, told)
    file = PlaceFile(tmp_path / "place")
    file.keep(Kept(1, 2, place))
    found = file.read()
    assert found is not None
    assert found.place.carried is not None
    assert math.isnan(found.place.carried.first)
    assert (found.place.log, found.place.episodes) == (place.log, place.episodes)
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
