"""The agent on a virtual clock: who is answered, with which policy, and what is refused."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from agent_service.inference import UniformPolicy
from agent_service.service import AgentService
from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Action, Architecture, Policy, Spec, Step
from rtcore.weights import expected_shapes, pack, sha256

ARCHITECTURE = Architecture(kind="tanh_gaussian_mlp", observation_dim=3, action_dim=2, hidden=[4])
SPEC = Spec(
    env="env0", env_id="test", incarnation=7, t0_ns=0, wall_t0_ns=0, tick_ns=5_000_000, unit_ns=10**9,
    observation_dim=3, action_dim=2, action_low=[-2.0, 0.0], action_high=[2.0, 1.0],
)  # fmt: skip


def step(tick: int, *, incarnation: int = 7, dim: int = 3) -> Step:
    return Step(
        env="env0", incarnation=incarnation, seq=tick, tick=tick, episode=0, episode_tick=tick, unit=0,
        due_ns=0, woke_ns=0, sent_ns=0, observation=np.zeros(dim, np.float32).tobytes(), reward=0.0,
        terminated=False, truncated=False, action=b"", decision=b"", answered_tick=-1, policy_version=-1,
        missed=False, fallback="", cause="", skipped=0, loop_ns=-1, reaction_ns=-1, drift=0.0, position=b"",
    )  # fmt: skip


def policy(version: int, *, mean_bias: float = 0.0, architecture: Architecture = ARCHITECTURE) -> Policy:
    """Acts tanh(mean_bias), without noise."""
    arrays = {name: np.zeros(shape, np.float32) for name, shape in expected_shapes(architecture).items()}
    arrays["mean.bias"][:] = mean_bias
    arrays["log_std.bias"][:] = -100
    weights = pack(arrays)
    return Policy(
        version=version, window=0, iterate=1, algo="sac", architecture=architecture, weights=weights,
        sha256=sha256(weights), created_ns=0,
    )  # fmt: skip


class Rig:
    """An agent, and the two ends that it talks to."""

    def __init__(self, hub: MemoryHub, seed: int = 3, last_published: Policy | None = None) -> None:
        self.clock = VirtualClock(1_000)
        self.env: Bus = hub.bus(channels.ENV_SERVER, self.clock)
        self.learner: Bus = hub.bus(channels.LEARNER, self.clock)
        self.ledger = Ledger(channels.AGENT, 1)
        bus = hub.bus(channels.AGENT, self.clock)
        self.agent = AgentService(RunConfig(seed=seed), bus, self.clock, self.ledger, last_published)
        self.actions = self.env.queue(channels.ACTION, "env0")
        self.specs = self.env.publisher(channels.SPEC, "env0")
        self.steps = self.env.publisher(channels.STEP, "env0")
        self.policies = self.learner.publisher(channels.POLICY)
        self.agent.attend()

    def answer(self, observed: Step) -> Action | None:
        self.agent.poll_policies()
        self.steps.put(observed)
        answers = self.actions.drain()
        assert len(answers) <= 1
        return answers[0].message if answers else None


@pytest.fixture
def rig() -> Rig:
    return Rig(MemoryHub())


def values(action: Action | None) -> np.ndarray:
    assert action is not None
    return np.frombuffer(action.values, np.float32)


def test_before_the_environment_is_known_nothing_is_answered(rig: Rig) -> None:
    assert rig.answer(step(0)) is None
    assert rig.ledger.counter("observations.unknown") == 1


def test_pi_0_answers_within_the_bounds_and_repeats_with_its_seed(rig: Rig) -> None:
    rig.specs.put(SPEC)
    answers = [rig.answer(step(tick)) for tick in range(50)]
    assert [(a.tick, a.incarnation, a.policy_version) for a in answers if a] == [(t, 7, 0) for t in range(50)]
    drawn = np.array([values(a) for a in answers])
    assert (drawn >= [-2, 0]).all() and (drawn <= [2, 1]).all() and drawn.std(0).min() > 0.2
    other = Rig(MemoryHub())
    other.specs.put(SPEC)
    np.testing.assert_array_equal(drawn, [values(other.answer(step(tick))) for tick in range(50)])


def test_what_waited_behind_a_stall_for_more_than_two_ticks_is_not_answered(rig: Rig) -> None:
    rig.specs.put(SPEC)
    rig.answer(step(0))
    rig.clock.advance_ns(25_000_000)  # 5 ticks
    for tick in range(1, 6):
        rig.steps.put(msgspec.structs.replace(step(tick), sent_ns=tick * 5_000_000))
    assert [received.message.tick for received in rig.actions.drain()] == [3, 4, 5]
    assert rig.ledger.counter("observations") == 6
    assert rig.ledger.counter("observations.superseded") == 2


def test_a_rehearsal_swaps_the_policy_in_and_leaves_no_other_trace(rig: Rig) -> None:
    rig.specs.put(SPEC)
    rig.answer(step(0))
    rehearsed = rig.answer(msgspec.structs.replace(step(0), rehearsal=True))
    assert rehearsed is not None and rehearsed.rehearsal and rehearsed.tick == 0
    assert rig.ledger.counter("observations") == rig.ledger.counter("actions") == 1
    assert rig.ledger.histogram("reaction").count == 1
    rig.answer(step(1))
    rig.policies.put(policy(1))
    rig.answer(msgspec.structs.replace(step(1), rehearsal=True))
    assert rig.ledger.counter("policies.adopted") == 1
    answer = rig.answer(step(2))
    assert answer is not None and answer.policy_version == 1 and not answer.rehearsal


def test_a_malformed_rehearsal_is_refused_like_a_step(rig: Rig) -> None:
    rig.specs.put(SPEC)
    assert rig.answer(msgspec.structs.replace(step(0, dim=4), rehearsal=True)) is None
    assert rig.ledger.counter("observations.invalid") == 1


def test_what_acting_fails_with_ends_the_run(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no more noise")

    rig.specs.put(SPEC)
    rig.answer(step(0))
    monkeypatch.setattr(UniformPolicy, "act", fail)
    assert rig.answer(step(1)) is None  # and nothing is raised into the bus
    with pytest.raises(RuntimeError, match="no more noise"):
        rig.agent.run(Stop())


def test_a_policy_acts_from_the_next_observation_on(rig: Rig) -> None:
    rig.specs.put(SPEC)
    rig.answer(step(0))
    rig.policies.put(policy(1, mean_bias=0.5))
    rig.clock.advance_ns(250)
    answer = rig.answer(step(1))
    assert answer is not None and answer.policy_version == 1
    np.testing.assert_allclose(values(answer), [2 * np.tanh(0.5), 0.5 + 0.5 * np.tanh(0.5)], rtol=1e-6)
    assert rig.ledger.counter("policies.adopted") == 1
    assert rig.ledger.histogram("publish_to_adopt").max == 1_250


def test_a_policy_that_never_acted_is_superseded_and_a_repeat_counts_apart(rig: Rig) -> None:
    rig.specs.put(SPEC)
    rig.answer(step(0))
    for version in (1, 2, 2, 3):
        rig.policies.put(policy(version))
    answer = rig.answer(step(1))
    rig.policies.put(policy(4))
    rig.agent.poll_policies()
    rig.agent.close()
    assert answer is not None and answer.policy_version == 3
    counts = {name: rig.ledger.counter(f"policies.{name}") for name in
              ("received", "adopted", "superseded", "repeated", "rejected", "unused")}  # fmt: skip
    assert counts == {"received": 4, "adopted": 1, "superseded": 2, "repeated": 1, "rejected": 0, "unused": 1}


def spoiled_hash(version: int) -> Policy:
    return msgspec.structs.replace(policy(version), sha256="0" * 64)


def spoiled_weights(version: int) -> Policy:
    return policy(version, mean_bias=float("nan"))


def other_shape(version: int) -> Policy:
    wider = Architecture(kind="tanh_gaussian_mlp", observation_dim=4, action_dim=2, hidden=[4])
    return policy(version, architecture=wider)


@pytest.mark.parametrize("make", [spoiled_hash, spoiled_weights, other_shape])
def test_a_bad_policy_is_refused_and_the_old_one_goes_on(rig: Rig, make: Callable[[int], Policy]) -> None:
    rig.specs.put(SPEC)
    rig.answer(step(0))
    rig.policies.put(policy(1, mean_bias=0.5))
    rig.answer(step(1))
    rig.policies.put(make(2))
    answer = rig.answer(step(2))
    assert answer is not None and answer.policy_version == 1
    assert rig.ledger.counter("policies.rejected") == 1
    assert "policy 2 refused" in rig.ledger.stats(0).events[-1].text


def test_a_version_from_the_past_is_refused(rig: Rig) -> None:
    rig.specs.put(SPEC)
    rig.answer(step(0))
    rig.policies.put(policy(5))
    rig.answer(step(1))
    rig.policies.put(policy(4))
    answer = rig.answer(step(2))
    assert answer is not None and answer.policy_version == 5
    assert rig.ledger.counter("policies.rejected") == 1


def test_a_malformed_observation_is_counted_and_not_answered(rig: Rig) -> None:
    rig.specs.put(SPEC)
    assert rig.answer(step(0, dim=4)) is None
    assert rig.ledger.counter("observations.invalid") == 1


def test_a_restarted_environment_is_answered_once_it_declares_itself(rig: Rig) -> None:
    rig.specs.put(SPEC)
    rig.answer(step(0))
    assert rig.answer(step(0, incarnation=8)) is None
    rig.specs.put(msgspec.structs.replace(SPEC, incarnation=8))
    answer = rig.answer(step(1, incarnation=8))
    assert answer is not None and answer.incarnation == 8


def test_beside_no_learner_the_last_published_policy_acts() -> None:
    rig = Rig(MemoryHub(), last_published=policy(9, mean_bias=0.5))
    rig.specs.put(SPEC)
    assert rig.answer(step(0)) is not None  # the environment is known now, and the policy can be checked
    answer = rig.answer(step(1))
    assert answer is not None and answer.policy_version == 9
    rig.policies.put(policy(9, mean_bias=0.5))  # a learner comes, with the same one
    rig.policies.put(policy(10))
    answer = rig.answer(step(2))
    assert answer is not None and answer.policy_version == 10
    assert rig.ledger.counter("policies.repeated") == 1


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
