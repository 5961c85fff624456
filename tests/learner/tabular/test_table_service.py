"""Tables in the learner's service: a scripted world of two states over the in-memory bus, in virtual time."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import pytest

from learner.algorithm import make_algorithm
from learner.replay import Replay
from learner.service import LearnerService
from rtcore import channels
from rtcore.clock import VirtualClock
from rtcore.config import (
    Algo,
    ConfigError,
    DriftConfig,
    EnvConfig,
    ForecastConfig,
    LearnerConfig,
    RunConfig,
    ScheduleConfig,
    TableConfig,
)
from rtcore.ledger import Ledger
from rtcore.memory_bus import MemoryHub
from rtcore.messages import Command, Policy, Spec, Step, StepBatch
from rtcore.run_dir import RunDir
from rtcore.spaces import Spaces
from rtcore.weights import verify

TICK_NS, TICKS = 100_000_000, 10  # ten ticks a unit
SPEC = Spec(
    env="env0", env_id="test", incarnation=7, t0_ns=0, wall_t0_ns=0, tick_ns=TICK_NS, unit_ns=TICKS * TICK_NS,
    observation_dim=1, action_dim=1, action_low=[0.0], action_high=[1.0], states=2, actions=2,
)  # fmt: skip
CONFIG = RunConfig(
    duration_s=0.0,
    env=EnvConfig(id="test", hz=10.0, drift=DriftConfig(kind="none")),
    learner=LearnerConfig(
        algo="q", gamma=0.5, replay_capacity=1000, batch=16, schedule=ScheduleConfig(l_f=4, gamma_f=0.5),
        forecast=ForecastConfig(l_p=2), table=TableConfig(step_size=0.5, epsilon=0.2, eta=0.5, entropy=0.5),
    ),
)  # fmt: skip
# Windows of 4 units: 2 update, 2 hold.


def action_at(seq: int) -> int:
    return int(seq % 3 > 0)  # 1 1 0 1 1 0 ...


def state_at(seq: int) -> int:
    return seq // 2 % 2  # 0 0 1 1 0 0 ...


def reward_at(seq: int) -> float:
    """Of the tick that led there: action 1 is worth more from state 0, and action 0 from state 1."""
    return 3.0 if action_at(seq) != state_at(seq - 1) else 1.0


def plain_q(transitions: int) -> list[list[float]]:
    """Q-learning of the first transitions, written down as it is in the textbook."""
    q = [[0.0, 0.0], [0.0, 0.0]]
    for seq in range(1, transitions + 1):
        state, action, after = state_at(seq - 1), action_at(seq), state_at(seq)
        q[state][action] += 0.5 * (reward_at(seq) + 0.5 * max(q[after]) - q[state][action])
    return q


def step(seq: int) -> Step:
    reset = seq == 0
    decision = b"" if reset else np.array([action_at(seq)], np.float32).tobytes()
    return Step(
        env="env0", incarnation=7, seq=seq, tick=seq, episode=0, episode_tick=seq, unit=seq // TICKS,
        due_ns=seq * TICK_NS, woke_ns=seq * TICK_NS, sent_ns=seq * TICK_NS,
        observation=np.array([state_at(seq)], np.float32).tobytes(), reward=0.0 if reset else reward_at(seq),
        terminated=False, truncated=False, action=decision, decision=decision, answered_tick=seq - 1,
        policy_version=0, missed=False, fallback="", cause="", skipped=0, loop_ns=0, reaction_ns=-1,
        drift=0.0, position=b"",
    )  # fmt: skip


class Rig:
    """A learner, its clock, and the other ends."""

    def __init__(self, run_dir: RunDir, algo: Algo, *, spec: Spec = SPEC, **learner: object) -> None:
        self.tick_ns = spec.tick_ns
        hub, self.clock, self.ledger = MemoryHub(), VirtualClock(0), Ledger(channels.LEARNER, 1)
        env = hub.bus(channels.ENV_SERVER, self.clock)
        specs, self.log = env.publisher(channels.SPEC, "env0"), env.publisher(channels.LOG, "env0")
        student = replace(CONFIG.learner, algo=algo, **learner)  # type: ignore[arg-type]
        config = replace(CONFIG, env=replace(CONFIG.env, unit_s=spec.unit_ns / 1e9), learner=student)
        bus = hub.bus(channels.LEARNER, self.clock)
        self.learner = LearnerService(config, run_dir, bus, self.clock, self.ledger)
        self.policies = hub.bus(channels.AGENT, self.clock).queue(channels.POLICY)
        specs.put(spec)

    def live(self, first: int, last: int) -> None:
        """Ticks first..last, one batch each, the learner catching up in between."""
        for seq in range(first, last + 1):
            self.clock.sleep_until_ns(seq * self.tick_ns)
            self.log.put(StepBatch(steps=[step(seq)]))
            self.learner.catch_up()

    def order(self, verb: Literal["hold", "resume"]) -> None:
        self.learner.command(Command(id=verb, verb=verb))

    def published(self) -> list[Policy]:
        return [received.message for received in self.policies.drain()]


@pytest.fixture
def run_dir(tmp_path: Path) -> RunDir:
    return RunDir.create(tmp_path / "run", CONFIG)


def tables(policies: list[Policy]) -> list[list[list[float]]]:
    found = [verify(policy, Spaces.of(SPEC))["probability"] for policy in policies]
    return [[[round(float(p), 5) for p in row] for row in table] for table in found]


def greedy_policy(q: list[list[float]]) -> list[list[float]]:
    return [[0.9, 0.1] if row[0] >= row[1] else [0.1, 0.9] for row in q]


def test_the_published_table_is_that_of_the_textbook(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "q")
    rig.live(0, 59)
    policies = rig.published()
    assert [(p.window, p.iterate, p.created_ns // TICK_NS) for p in policies] == [
        (0, 1, 9),
        (0, 2, 19),
        (1, 1, 49),
        (1, 2, 59),
    ]
    # due as the tick comes, before its own transition is learned
    assert tables(policies) == [greedy_policy(plain_q(seq - 1)) for seq in (9, 19, 49, 59)]
    assert tables(policies)[-1] == [[0.1, 0.9], [0.9, 0.1]]  # the better action of either state
    counter = rig.ledger.counter
    assert (counter("learned"), counter("gradient_steps"), counter("published_in_hold")) == (59, 59, 0)
    rig.learner.close()
    np.testing.assert_allclose(rig.learner._algorithm.state().tensors["q"], plain_q(59))  # type: ignore[union-attr]


def test_a_hold_that_learns_nothing_is_made_up_for_in_the_next_window(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "q", hold_learning="off")
    rig.live(0, 39)
    assert rig.ledger.counter("gradient_steps") == 19  # the tick that ends unit 1 belongs to the hold
    rig.live(40, 40)
    assert rig.ledger.counter("gradient_steps") == 40


def test_the_forecasting_policy_comes_once_a_window(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "fq")
    rig.live(0, 59)
    policies = rig.published()
    assert [(p.window, p.iterate) for p in policies] == [(0, 1), (0, 2), (1, 1)]
    # the policy of window 0 was reactive, improved by the transitions of two units; then there is a forecast
    assert rig.ledger.counter("policy_steps") == 19 + 1
    # tables were kept as units 2 and 3 ended, at ticks 30 and 40; in the window [4, 8) the line through
    # them is read 4 units after t_m: w = (-4, 5)
    older, newer = np.array(plain_q(29)), np.array(plain_q(39))
    assert tables(policies)[-1] == greedy_policy((5 * newer - 4 * older).tolist())


def test_the_policy_gradient_makes_one_iterate_a_unit(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "npg", forecast=ForecastConfig(kind="none"))
    rig.live(0, 59)
    policies = rig.published()
    assert [(p.window, p.iterate) for p in policies] == [(0, 1), (0, 2), (1, 1), (1, 2)]
    assert rig.ledger.counter("policy_steps") == 4
    assert rig.ledger.counter("gradient_steps") == 59
    # window 0 began with an empty table; eta tau / (1 - gamma) = 1/2 and eta / (1 - gamma) = 1, so that two
    # steps from uniform are softmax(Q + Q / 2), and one step softmax(Q)
    assert tables(policies)[:2] == [[[0.5, 0.5], [0.5, 0.5]]] * 2
    for table, share in zip(tables(policies)[2:], (1.0, 1.5), strict=True):
        expected = np.exp(share * np.array(plain_q(39)))
        expected /= expected.sum(1, keepdims=True)
        np.testing.assert_allclose(table, 0.8 * expected + 0.1, atol=2e-5)


def test_a_learner_that_comes_back_learns_nothing_twice(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "fq")
    rig.live(0, 44)
    rig.learner.close()
    second = Rig(run_dir, "fq")
    second.live(40, 59)  # the log repeats what its cache holds
    second.learner.close()
    algorithm = second.learner._algorithm
    assert algorithm is not None and algorithm.gradient_steps == 59
    np.testing.assert_allclose(algorithm.state().tensors["q"], plain_q(59))


def test_an_operators_hold_stops_the_policy_gradient(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "npg", schedule=ScheduleConfig(l_f=6, gamma_f=1.0))
    rig.live(0, 12)
    rig.order("hold")
    rig.live(13, 42)
    assert (rig.ledger.counter("policy_steps"), len(rig.published())) == (1, 1)
    rig.order("resume")
    rig.live(43, 49)
    assert [policy.iterate for policy in rig.published()] == [5]
    assert rig.ledger.counter("policy_steps") == 2
    assert rig.ledger.counter("withheld") == 0


def test_what_was_overwritten_before_it_was_read_is_counted(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "q", hold_learning="off", replay_capacity=16)
    rig.live(0, 40)
    # tick 20 and on wait for window 1: 21 transitions, of which the ring holds 16
    assert rig.ledger.counter("unread") == 5
    assert rig.ledger.counter("gradient_steps") == 19 + 16


def test_a_checkpoint_without_its_replay_is_refused(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "q")
    rig.live(0, 19)
    rig.learner.close()
    shutil.rmtree(run_dir.learner_dir / "replay")
    second = Rig(run_dir, "q")
    with pytest.raises(ConfigError, match=r"learner.on_mismatch.*: it has read 19 transitions of 0"):
        second.live(20, 21)


def test_iterates_come_shortly_before_short_units_end(run_dir: RunDir) -> None:
    rig = Rig(run_dir, "q", spec=msgspec.structs.replace(SPEC, tick_ns=5_000_000, unit_ns=100_000_000))
    rig.live(0, 19)
    # a quarter of the unit is 25 ms: with ticks of 5 ms, tick 15
    assert [policy.created_ns // rig.tick_ns for policy in rig.published()] == [15]


@pytest.mark.parametrize("algo", ["sac", "fsac", "rsac"])
def test_networks_are_refused_in_a_finite_world(algo: Algo) -> None:
    run = replace(CONFIG, learner=replace(CONFIG.learner, algo=algo))
    with pytest.raises(
        ConfigError, match=f"learner.algo = '{algo}': must be one of q, fq, npg, tempo: test is a finite"
    ):
        make_algorithm(run, Spaces.of(SPEC), 0, Replay(9, 1, 1))


@pytest.mark.parametrize("algo", ["q", "fq", "npg", "tempo"])
def test_tables_are_refused_in_a_continuous_world(algo: Algo) -> None:
    run = replace(CONFIG, learner=replace(CONFIG.learner, algo=algo))
    with pytest.raises(ConfigError, match="must be one of sac, fsac, rsac: test is a continuous world"):
        make_algorithm(run, Spaces(1, 1), 0, Replay(9, 1, 1))


def test_a_learner_of_tables_does_not_load_torch() -> None:
    code = """
import sys
import learner.__main__
from learner.algorithm import make_algorithm, prepare
from learner.replay import Replay
from rtcore.config import LearnerConfig, RunConfig
from rtcore.spaces import Spaces
for algo in ("q", "fq", "npg", "tempo"):
    config = RunConfig(learner=LearnerConfig(algo=algo))
    prepare(config.learner)(1)
    make_algorithm(config, Spaces(1, 1, 1, 2), 0, Replay(9, 1, 1))
sys.exit("torch" in sys.modules)
"""
    root = Path(__file__).parents[3]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False, timeout=50).returncode == 0
