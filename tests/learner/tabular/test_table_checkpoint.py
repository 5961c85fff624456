"""Tables go on bit for bit from a checkpoint, whatever they were in the middle of."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from learner import checkpoint
from learner.checkpoint import CheckpointError, State
from learner.replay import Replay
from learner.tabular.fq import Fq
from learner.tabular.npg import Npg
from learner.tabular.q import QLearning
from rtcore.spaces import Spaces
from tests.learner.tabular.lived import TWO_STATES, table_config, wander, window

TABLES: dict[str, Callable[..., QLearning]] = {"q": QLearning, "fq": Fq, "npg": Npg}
LENGTH, UPDATE = 4, 2


def make(algo: str, replay: Replay, spaces: Spaces = TWO_STATES) -> QLearning:
    forecast = {"l_p": 3, "trust": "judged", "horizon": "replay"}
    config = table_config(algo, forecast=forecast, step_size=0.3, write_back=0.5, eta=0.3, entropy=0.5)
    return TABLES[algo](config, spaces, 0, replay)


def live_on(found: QLearning, replay: Replay, units: range, seed: int) -> None:
    """Units of a few transitions each, in windows of 4 units."""
    rng = np.random.default_rng(seed)
    for unit in units:
        m, g = divmod(unit, LENGTH)
        if g == 0:
            found.begin_window(window(m, unit, UPDATE, LENGTH - UPDATE), unit)
        wander(replay, rng, 7, unit)
        found.update(improve_policy=g < UPDATE)
        if g < UPDATE:
            found.iterate(g + 1)
        found.end_unit(unit)


def same(one: State, other: State) -> bool:
    return one.scalars == other.scalars and all(
        np.array_equal(one.tensors[name], other.tensors[name]) for name in one.tensors | other.tensors
    )


@pytest.mark.parametrize("algo", TABLES)
def test_a_loaded_learner_goes_on_bit_for_bit(algo: str, tmp_path: Path) -> None:
    replay = Replay(1000, 1, 1)
    first = make(algo, replay)
    live_on(first, replay, range(17), seed=1)  # a unit into the fifth window; forecasts were judged
    wander(replay, np.random.default_rng(2), 5, 17)  # not read yet
    checkpoint.save(tmp_path, first.state())

    other = deepcopy(replay)
    second = make(algo, other)
    second.load(checkpoint.load(tmp_path))
    assert same(first.state(), second.state())
    first.begin_window(window(4, 16, 2, 2), 17)
    second.begin_window(window(4, 16, 2, 2), 17)  # entered again by the learner that came back
    first.update(improve_policy=False)
    second.update(improve_policy=False)
    assert first.gradient_steps == second.gradient_steps == 17 * 7 + 5
    for units in (range(17, 24), range(24, 33)):
        live_on(first, replay, units, seed=units.start)
        live_on(second, other, units, seed=units.start)
        assert same(first.state(), second.state())
        assert np.array_equal(first.policy_arrays()["probability"], second.policy_arrays()["probability"])
    if algo != "q":
        assert first.metrics() == second.metrics()
        assert first.metrics()["forecast/windows"] >= 6


@pytest.mark.parametrize("algo", TABLES)
def test_state_is_a_copy(algo: str) -> None:
    replay = Replay(1000, 1, 1)
    found = make(algo, replay)
    live_on(found, replay, range(9), seed=1)
    before = found.state()
    tensors = {name: array.copy() for name, array in before.tensors.items()}
    live_on(found, replay, range(9, 12), seed=2)
    assert all(np.array_equal(before.tensors[name], array) for name, array in tensors.items())


@pytest.mark.parametrize(
    ("algo", "spaces", "complaint"),
    [
        ("q", Spaces(1, 1, 2, 3), r"actions 2 \(wanted 3\)"),
        (
            "fq",
            Spaces(1, 1, 2, 3),
            r"actions 2 \(wanted 3\).*history.3 float64\[2, 2\] \(wanted float64\[2, 3\]\)",
        ),
        ("npg", Spaces(1, 1, 5, 2), r"log_policy float64\[2, 2\] \(wanted float64\[5, 2\]\)"),
    ],
)
def test_another_worlds_checkpoint_is_refused_whole(algo: str, spaces: Spaces, complaint: str) -> None:
    replay = Replay(1000, 1, 1)
    found = make(algo, replay)
    live_on(found, replay, range(5), seed=1)
    other = make(algo, replay, spaces)
    before: Any = other.state()
    with pytest.raises(CheckpointError, match=complaint):
        other.load(found.state())
    assert same(before, other.state())


def test_one_algorithms_checkpoint_is_not_anothers() -> None:
    with pytest.raises(CheckpointError, match=r"algo 'fq' \(wanted 'npg'\)"):
        make("npg", Replay(9, 1, 1)).load(make("fq", Replay(9, 1, 1)).state())
