"""When a run began: said once, kept by every later life, whatever became of the monotonic clock."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from msgspec.structs import replace

from rtcore import epoch
from rtcore.config import ConfigError
from rtcore.epoch import Epoch, agree, on_this_clock, read, settle
from tests.rtcore.bus_samples import spec

SECOND = 1_000_000_000
FIRST = Epoch(t0_ns=100 * SECOND, wall_t0_ns=5_000 * SECOND, boot_id="one")


def proposed(t0_s: int, boot_id: str = "one") -> Epoch:
    return Epoch(t0_ns=t0_s * SECOND, wall_t0_ns=0, boot_id=boot_id)


def test_the_first_life_sets_it_and_later_ones_keep_it(tmp_path: Path) -> None:
    path = tmp_path / "epoch.json"
    assert read(path) is None
    assert settle(path, FIRST, now_ns=1, wall_ns=2) == (FIRST, None)
    assert read(path) == FIRST
    for life in (2, 3):
        found, problem = settle(path, proposed(170), now_ns=170 * SECOND, wall_ns=9_999 * SECOND)
        assert problem is None
        assert (found.t0_ns, found.wall_t0_ns, found.lives) == (FIRST.t0_ns, FIRST.wall_t0_ns, life)
        assert read(path) == found
    assert [entry.name for entry in tmp_path.iterdir()] == ["epoch.json"]


def test_after_a_reboot_it_is_converted_by_the_wall_clock(tmp_path: Path) -> None:
    """T0 was at Unix time 5000 s; the host came up again at 5120 s, and reads 30 s at 5150 s. So T0 is 150 s
    ago, at 30 - 150 = -120 s of the new clock. A third life of the same boot finds it there."""
    path = tmp_path / "epoch.json"
    settle(path, FIRST, now_ns=1, wall_ns=2)
    found, _ = settle(path, proposed(31, "two"), now_ns=30 * SECOND, wall_ns=5_150 * SECOND)
    assert found == Epoch(t0_ns=-120 * SECOND, wall_t0_ns=5_000 * SECOND, boot_id="two", lives=2)
    again, _ = settle(path, proposed(41, "two"), now_ns=40 * SECOND, wall_ns=6_000 * SECOND)
    assert (again.t0_ns, again.lives) == (-120 * SECOND, 3)


def test_what_all_agree_on_is_converted_once(tmp_path: Path) -> None:
    """As above: -120 s. The next to ask, whose wall clock was set by a second, finds the same."""
    path = tmp_path / "epoch.json"
    mine = proposed(7)
    assert agree(path, FIRST, now_ns=1, wall_ns=2)[0] is FIRST
    assert agree(path, mine, now_ns=1, wall_ns=2) == (FIRST, None)
    for wall_s in (5_150, 5_151):
        found, _ = agree(path, proposed(31, "two"), now_ns=30 * SECOND, wall_ns=wall_s * SECOND)
        assert (found.t0_ns, found.boot_id, found.lives) == (-120 * SECOND, "two", 1)


def test_a_declaration_of_another_host_is_read_by_the_wall_clock() -> None:
    """T0 was at Unix time 5000 s, which is 150 s ago; here it is 30 s by the monotonic clock."""
    declared = replace(spec(), t0_ns=100 * SECOND, wall_t0_ns=5_000 * SECOND, host="there")
    now = {"now_ns": 30 * SECOND, "wall_ns": 5_150 * SECOND}
    assert on_this_clock(declared, **now, boot_id="here") == replace(declared, t0_ns=-120 * SECOND)
    assert on_this_clock(declared, **now, boot_id="there") is declared
    virtual = replace(declared, host="")
    assert on_this_clock(virtual, **now, boot_id="here") is virtual


def test_of_those_who_come_at_once_one_sets_it(tmp_path: Path) -> None:
    path = tmp_path / "epoch.json"
    found: list[Epoch] = []

    def come(t0_s: int) -> None:
        found.append(settle(path, proposed(t0_s), now_ns=0, wall_ns=0)[0])

    threads = [threading.Thread(target=come, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({one.t0_ns for one in found}) == 1
    assert [one.lives for one in found].count(1) == 1


def test_where_it_cannot_be_written_the_run_goes_on_and_says_so(tmp_path: Path) -> None:
    found, problem = settle(tmp_path / "none" / "epoch.json", FIRST, now_ns=1, wall_ns=2)
    assert found == FIRST
    assert isinstance(problem, FileNotFoundError)


@pytest.mark.parametrize("content", [b"", b'{"t0_ns": 1', b'{"t0_ns": "soon"}'])
def test_a_damaged_one_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "epoch.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"^epoch = '.*epoch\.json': must be a run's beginning \("):
        settle(path, FIRST, now_ns=1, wall_ns=2)


def test_a_boot_has_a_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert epoch.this_boot() == epoch.this_boot() != ""
    monkeypatch.setattr(epoch, "_BOOT_ID", tmp_path / "none")
    assert epoch.this_boot() == ""
