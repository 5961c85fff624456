"""When a run began, for every life of the process that owns its clock.

The first env server of a run sets T0 and writes it down; each later one goes on by it, so ticks, units, the
drift and the duration follow the wall clock whoever dies. Stamps are of the host's monotonic clock, which
begins anew when the host does: then T0 is converted by the wall clock, and may lie before 0.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from rtcore.config import ConfigError
from rtcore.files import write_atomic, write_once
from rtcore.messages import Spec

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, kw_only=True)
class Epoch:
    """A run's beginning.

    Attributes:
        t0_ns: deadline of tick 0, on the monotonic clock of this boot of this host; may be negative.
        wall_t0_ns: the same instant as Unix time.
        boot_id: the boot whose clock `t0_ns` is of; empty where the system has none.
        lives: env servers so far that kept the run's clock, this one included.
    """

    t0_ns: int
    wall_t0_ns: int
    boot_id: str
    lives: int = 1

    def at(self, *, now_ns: int, wall_ns: int, boot_id: str) -> Epoch:
        """The same beginning on the clock of the boot `boot_id`, which reads `now_ns` at Unix time
        `wall_ns`."""
        if boot_id == self.boot_id:
            return self
        t0_ns = now_ns - (wall_ns - self.wall_t0_ns)
        return replace(self, t0_ns=t0_ns, boot_id=boot_id)


def this_boot() -> str:
    """What names this boot of this host; empty where the system does not say."""
    try:
        return _BOOT_ID.read_text().strip()
    except OSError:
        return ""


def on_this_clock(spec: Spec, *, now_ns: int, wall_ns: int, boot_id: str) -> Spec:
    """The declaration with T0 on the clock of this boot: another host's monotonic clock began when that host
    did, so the wall clocks are gone by, which must agree."""
    if spec.host in ("", boot_id):
        return spec
    return msgspec.structs.replace(spec, t0_ns=now_ns - (wall_ns - spec.wall_t0_ns))


def read(path: Path) -> Epoch | None:
    """The run's beginning as it was written down; None if it was not.

    Raises:
        ConfigError: the file is damaged. The run cannot go on: nobody knows its time.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=Epoch)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError("epoch", str(path), f"must be a run's beginning ({error})") from error


def agree(path: Path, proposed: Epoch, *, now_ns: int, wall_ns: int) -> tuple[Epoch, OSError | None]:
    """What the run goes by: `proposed`, that very object, if nobody was faster; else what is written there.

    Returns:
        The beginning on this boot's clock; and why it is not on the disk, if so.

    Raises:
        ConfigError: see `read`.
    """
    try:
        write_once(path, _encode(proposed))
    except FileExistsError:
        known = read(path)
        assert known is not None
        here = known.at(now_ns=now_ns, wall_ns=wall_ns, boot_id=proposed.boot_id)
        if here is not known:  # so that all who come after this one on the new boot convert it alike
            with suppress(OSError):
                write_atomic(path, _encode(here))
        return here, None
    except OSError as error:
        return proposed, error
    return proposed, None


def settle(path: Path, proposed: Epoch, *, now_ns: int, wall_ns: int) -> tuple[Epoch, OSError | None]:
    """What a life of the env server goes by: `proposed` if it is the first, else what the first one wrote.

    Returns:
        The beginning on this boot's clock, with this life in `lives`; and why it is not on the disk, if so.

    Raises:
        ConfigError: see `read`.
    """
    known, problem = agree(path, proposed, now_ns=now_ns, wall_ns=wall_ns)
    if known is proposed:
        return proposed, problem
    epoch = replace(known, lives=known.lives + 1)
    try:
        write_atomic(path, _encode(epoch))
    except OSError as error:
        return epoch, error
    return epoch, None


def _encode(epoch: Epoch) -> bytes:
    return msgspec.json.encode(epoch) + b"\n"
