"""The agent in a finite world: tables choose by number, and what is none of that world is refused."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from rtcore.memory_bus import MemoryHub
from rtcore.messages import Architecture, Policy, Step
from rtcore.weights import pack, sha256
from tests.agent_service.rig import ARCHITECTURE, SPEC, Rig, policy, step, values

# A finite world of three states and two actions.
TABLE = Architecture(
    kind="categorical_table", observation_dim=1, action_dim=1, hidden=[], states=3, actions=2
)
FINITE = msgspec.structs.replace(
    SPEC, observation_dim=1, action_dim=1, action_low=[0.0], action_high=[1.0], states=3, actions=2
)


def at_state(tick: int, state: float) -> Step:
    return msgspec.structs.replace(step(tick, dim=1), observation=np.array([state], np.float32).tobytes())


def table(version: int, rows: list[list[float]], architecture: Architecture = TABLE) -> Policy:
    weights = pack({"probability": np.array(rows, np.float32)})
    return msgspec.structs.replace(
        policy(version), architecture=architecture, weights=weights, sha256=sha256(weights)
    )


def test_in_a_finite_world_pi_0_and_then_a_table_chooses_by_number(rig: Rig) -> None:
    rig.specs.put(FINITE)
    drawn = [values(rig.answer(at_state(tick, tick % 3))).tolist() for tick in range(50)]
    assert {(number,) for (number,) in drawn} == {(0.0,), (1.0,)}
    rig.policies.put(table(1, [[1, 0], [0, 1], [1, 0]]))
    answers = [rig.answer(at_state(50 + k, state)) for k, state in enumerate((0, 1, 2, 1))]
    assert [(values(a).tolist(), a.policy_version) for a in answers if a] == [
        ([0.0], 1), ([1.0], 1), ([0.0], 1), ([1.0], 1),
    ]  # fmt: skip


@pytest.mark.parametrize("state", [-1.0, 3.0, 0.5, float("nan"), float("inf"), -float("inf"), 1e30])
def test_a_state_that_there_is_not_is_counted_and_not_answered(rig: Rig, state: float) -> None:
    rig.specs.put(FINITE)
    assert rig.answer(at_state(0, state)) is None
    assert rig.answer(msgspec.structs.replace(at_state(0, state), rehearsal=True)) is None
    assert rig.ledger.counter("observations.invalid") == 2
    assert rig.answer(at_state(1, 2.0)) is not None


@pytest.mark.parametrize(
    ("rows", "architecture"),
    [
        ([[0.5, 0.6]] * 3, TABLE),
        ([[-0.5, 1.5]] * 3, TABLE),
        ([[float("nan"), 1.0]] * 3, TABLE),
        ([[0.5, 0.5]] * 2, TABLE),
        ([[0.5, 0.5]] * 4, msgspec.structs.replace(TABLE, states=4)),
    ],
)
def test_a_table_that_is_none_of_this_world_is_refused(
    rig: Rig, rows: list[list[float]], architecture: Architecture
) -> None:
    rig.specs.put(FINITE)
    rig.answer(at_state(0, 0))
    rig.policies.put(table(1, rows, architecture))
    answer = rig.answer(at_state(1, 0))
    assert answer is not None and answer.policy_version == 0
    assert rig.ledger.counter("policies.rejected") == 1


def test_a_network_cannot_act_in_a_finite_world_nor_a_table_in_another() -> None:
    network = msgspec.structs.replace(ARCHITECTURE, observation_dim=1, action_dim=1)
    for spec, offered, observed in (
        (FINITE, policy(1, architecture=network), at_state),
        (SPEC, table(1, [[0.5, 0.5]] * 3), lambda tick, _: step(tick)),
    ):
        rig = Rig(MemoryHub())
        rig.specs.put(spec)
        rig.answer(observed(0, 0))
        rig.policies.put(offered)
        answer = rig.answer(observed(1, 0))
        assert answer is not None and answer.policy_version == 0
        assert rig.ledger.counter("policies.rejected") == 1
