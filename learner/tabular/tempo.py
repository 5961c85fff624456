"""The paper's motivating example (section 1): two arms, and a preference that moves at a scripted tempo."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import State, require_fit
from learner.replay import Replay
from learner.schedule.outlook import Outlook
from learner.tabular.q import SAME, entropy, table_architecture
from learner.tabular.table import Table
from rtcore.config import ConfigError, LearnerConfig
from rtcore.spaces import Spaces
from rtcore.windows import Window


class Tempo:
    """Learns nothing: pi_t(a0) = beta_t, which rises linearly with the unit t.

        beta_t = clip((t - begin) / span, 0, 1)

    An early and fast rise is the paper's conservative policy, a late and slow one its pessimistic one.

    Attributes:
        architecture: of the policy that `policy_arrays` gives.
        gradient_steps: 0.
        policy_steps: changes of beta so far.
    """

    algo = "tempo"

    def __init__(self, config: LearnerConfig, spaces: Spaces, seed: int, replay: Replay) -> None:
        """`seed` and `replay` are for algorithms that learn.

        Raises:
            ConfigError: the world has not one state and two actions.
        """
        del seed, replay
        if (spaces.states, spaces.actions) != (1, 2):
            allowed = f"needs 1 state and 2 actions; this world has {spaces.states} and {spaces.actions}"
            raise ConfigError("learner.algo", self.algo, allowed)
        self.architecture = table_architecture(spaces)
        self.gradient_steps = 0
        self.policy_steps = 0
        self.unread = 0  # nothing is learned
        self._begin, self._span = config.table.tempo_begin, config.table.tempo_span
        self._start = 0  # t_m
        self._beta = self._beta_in(0)
        self._shown = False  # whether `iterate` has ever said that there is a policy

    def update(self, *, improve_policy: bool) -> None:
        """Nothing is learned."""

    def iterate(self, g: int) -> bool:
        """Iterate g acts from unit t_m + g on: give it that unit's beta. Says whether it is another one."""
        beta = self._beta_in(self._start + g)
        if self._shown and beta == self._beta:
            return False
        self.policy_steps += beta != self._beta
        self._beta, self._shown = beta, True
        return True

    def begin_window(self, window: Window, unit: int) -> None:
        """Remember t_m."""
        del unit
        self._start = window.start

    def outlook(self, start: int, length: int) -> Outlook | None:  # noqa: ARG002 (the protocol's signature)
        """Nothing is foreseen."""
        return None

    def end_unit(self, unit: int) -> None:
        """Only iterates move beta: in a hold it stays as it is."""

    def _beta_in(self, unit: int) -> float:
        return min(max((unit - self._begin) / self._span, 0.0), 1.0)

    def _policy(self) -> Table:
        return np.array([[self._beta, 1.0 - self._beta]])

    def policy_arrays(self) -> dict[str, NDArray[np.float32]]:
        """The probability of both actions, float32 [1, 2]."""
        return {"probability": self._policy().astype(np.float32)}

    def metrics(self) -> dict[str, float]:
        """tempo/beta: of the newest policy; entropy: of that policy, in nats."""
        return {"tempo/beta": self._beta, "entropy": entropy(self._policy())}

    def state(self) -> State:
        """Everything needed to go on bit for bit."""
        tensors = {"beta": np.array([self._beta])}
        scalars = {
            "algo": self.algo,
            "states": self.architecture.states,
            "actions": self.architecture.actions,
            "policy_steps": self.policy_steps,
            "start": self._start,
            "shown": self._shown,
        }
        return State(tensors, scalars)

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        require_fit(state, self.state(), same=SAME)
        self._beta = float(state.tensors["beta"][0])
        self.policy_steps = int(state.scalars["policy_steps"])
        self._start = int(state.scalars["start"])
        self._shown = bool(state.scalars["shown"])
