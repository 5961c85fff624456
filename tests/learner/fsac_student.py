"""A small FSAC for tests: in its windows, at a probe, and held against another student bit by bit."""

from __future__ import annotations

import torch

from learner.deep.fsac import Fsac
from learner.deep.sac import Sac
from rtcore.config import LearnerConfig
from rtcore.windows import Window
from tests.learner.formulas import critic_value
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, forq, small_config

UPDATES_PER_UNIT = 4
WINDOW_0, WINDOW_1 = Window(m=0, start=0, update=3, hold=1), Window(m=1, start=4, update=3, hold=1)


def make_fsac(config: LearnerConfig | None = None, seed: int = 3) -> Fsac:
    config = config or small_config(algo="fsac", forecast=forq())
    return Fsac(config, OBSERVATION_DIM, ACTION_DIM, seed, filled_replay())


def learn_units(student: Sac, units: range) -> None:
    for unit in units:
        for _ in range(UPDATES_PER_UNIT):
            student.update(improve_policy=True)
        student.end_unit(unit)


def in_second_window(config: LearnerConfig | None = None) -> Fsac:
    fsac = make_fsac(config)
    fsac.begin_window(WINDOW_0, 0)
    learn_units(fsac, range(4))
    fsac.begin_window(WINDOW_1, 4)
    return fsac


def probe() -> tuple[torch.Tensor, torch.Tensor]:
    """A batch of observations and actions."""
    rows = small_config().batch
    observation = torch.linspace(-1, 1, rows * OBSERVATION_DIM).view(rows, OBSERVATION_DIM)
    return observation, torch.linspace(-0.9, 0.9, rows * ACTION_DIM).view(rows, ACTION_DIM)


def climbed(fsac: Fsac) -> torch.Tensor:
    """The Q that the policy climbs, at the probe."""
    fsac._enter(*probe())
    return fsac._climb()[0]


def live_value(fsac: Fsac) -> torch.Tensor:
    return critic_value(fsac._critic, *probe())


def same_bits(first: Sac, second: Sac, prefix: str = "") -> bool:
    a, b = first.state().tensors, second.state().tensors
    names = [name for name in a if name.startswith(prefix) and not name.startswith("history.")]
    assert names
    return all(a[name].tobytes() == b[name].tobytes() for name in names)


def times(fsac: Fsac) -> list[int]:
    return [snapshot.time for snapshot in fsac._history.snapshots]


def window(m: int, length: int = 4) -> Window:
    return Window(m=m, start=length * m, update=length - 1, hold=1)
