"""The agent on a virtual clock: who is answered, with which policy, and what is refused."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from agent_service.adoption import Adoption, Past
from agent_service.inference import UniformPolicy
from rtcore.histogram import Histogram
from rtcore.lifecycle import Stop
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Architecture, Policy
from rtcore.weights import WeightsError
from tests.agent_service.rig import SPEC, Rig, policy, step, values


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


def test_agents_of_a_fleet_explore_apart() -> None:
    drawn = []
    for number in (0, 1, 1, 2):
        one = Rig(MemoryHub(), number=number)
        one.specs.put(SPEC)
        drawn.append(tuple(values(one.answer(step(0)))))
    assert drawn[1] == drawn[2] and len(set(drawn)) == 3


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


def test_beside_no_learner_the_last_published_policy_acts_from_the_first_answer_on() -> None:
    rig = Rig(MemoryHub(), past=Past(newest=policy(9, mean_bias=0.5)))
    rig.specs.put(SPEC)
    answer = rig.answer(step(0))
    assert answer is not None and answer.policy_version == 9
    rig.policies.put(policy(9, mean_bias=0.5))  # a learner comes, with the same one
    rig.policies.put(policy(10))
    answer = rig.answer(step(1))
    assert answer is not None and answer.policy_version == 10
    assert rig.ledger.counter("policies.repeated") == 1


class OnlyVersion2:
    """A verifier that knows whose version 2 is."""

    def check(self, policy: Policy) -> None:
        if policy.version != 2:
            raise WeightsError("not signed by the learner")


def test_what_the_verifier_refuses_is_not_adopted(rig: Rig) -> None:
    adoption = Adoption(SPEC, rig.ledger, OnlyVersion2())
    adoption.offer(policy(1), 0)
    assert adoption.take() is None
    adoption.offer(policy(2), 0)
    assert adoption.take() is not None
    for version in (1, 3):  # whatever version it claims
        adoption.offer(policy(version), 0)
    assert adoption.take() is None
    counts = [rig.ledger.counter(f"policies.{name}") for name in ("received", "rejected", "foreign")]
    assert counts == [1, 0, 3]


def test_how_old_a_policy_is_at_its_first_swap_is_told_of_new_ones_alone() -> None:
    """Version 4 comes from the file and 5 is what an earlier life had: not how long a publication takes."""
    rig = Rig(MemoryHub(), past=Past(newest=policy(4), floor=5))
    rig.specs.put(SPEC)
    rig.answer(step(0))
    rig.policies.put(policy(5))
    rig.answer(step(1))
    assert _latencies(rig) == 0
    rig.policies.put(policy(6))
    rig.answer(step(2))
    assert _latencies(rig) == 1
    assert rig.ledger.counter("policies.adopted") == 2

    rig = Rig(MemoryHub(), past=Past(newest=policy(4)))
    rig.specs.put(SPEC)
    answer = rig.answer(step(0))
    assert answer is not None and answer.policy_version == 4
    assert _latencies(rig) == 0


def _latencies(rig: Rig) -> int:
    return Histogram.from_bytes(rig.ledger.stats(0).histograms["publish_to_adopt"]).count


def test_the_heart_stops_while_an_answer_hangs(rig: Rig) -> None:
    """An answer that began at 1000 ns: after 1 s it hangs, which is said once; then it comes after all."""

    def beats_ns() -> int:
        return rig.ledger.stats(rig.clock.now_ns()).beat_ns

    rig.agent._beat()
    assert beats_ns() == 1_000
    rig.agent._acting_since_ns = 1_000
    rig.clock.advance_ns(999_999_999)
    rig.agent._beat()
    assert beats_ns() == 1_000_000_999
    for _ in range(2):
        rig.clock.advance_ns(500_000_000)
        rig.agent._beat()
        assert beats_ns() == 1_000_000_999
    stats = rig.ledger.stats(rig.clock.now_ns())
    assert [event.text for event in stats.events] == [
        "an observation has been answered for 1.5 s: acting hangs"
    ]
    rig.agent._acting_since_ns = 0
    rig.agent._beat()
    assert beats_ns() == rig.clock.now_ns()


def test_an_answer_is_over_when_it_is_given(rig: Rig) -> None:
    rig.specs.put(SPEC)
    rig.answer(step(0))
    assert rig.agent._acting_since_ns == 0
