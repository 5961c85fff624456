"""The agent on a virtual clock, and the two ends that it talks to."""

from __future__ import annotations

import numpy as np

from agent_service.adoption import Past
from agent_service.service import AgentService
from rtcore import channels
from rtcore.bus import Bus
from rtcore.clock import VirtualClock
from rtcore.config import RunConfig
from rtcore.ledger import Ledger
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

    def __init__(self, hub: MemoryHub, seed: int = 3, past: Past | None = None, number: int = 0) -> None:
        self.clock = VirtualClock(1_000)
        self.env: Bus = hub.bus(channels.ENV_SERVER, self.clock)
        self.learner: Bus = hub.bus(channels.LEARNER, self.clock)
        self.ledger = Ledger(channels.AGENT, 1)
        bus = hub.bus(channels.AGENT, self.clock)
        self.agent = AgentService(RunConfig(seed=seed), bus, self.clock, self.ledger, past, number=number)
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


def values(action: Action | None) -> np.ndarray:
    assert action is not None
    return np.frombuffer(action.values, np.float32)
