"""Q-learning in a table, reactive: the policy is epsilon-greedy of Q as it is now (Watkins, 1992)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import CheckpointError, State, require_fit
from learner.replay import Columns, Replay
from learner.schedule.outlook import Outlook
from learner.tabular.table import Table, epsilon_greedy, q_update
from rtcore.config import LearnerConfig
from rtcore.messages import Architecture
from rtcore.spaces import Spaces
from rtcore.windows import Window

SAME = ("algo", "states", "actions")  # what a checkpoint must agree on

# A turn of the learner's loop takes as many transitions as this; 1000 take 14 ms on the machine that
# other measurements here are from, well within the 50 ms by which policies are published early.
_MOST_AT_ONCE = 1000


class QLearning:
    """Learns from every transition once, in the order in which they were lived. Nothing is drawn.

    Attributes:
        architecture: of the policy that `policy_arrays` gives.
        gradient_steps: transitions learned from so far.
        policy_steps: how many of them changed the policy while it was to be improved.
        unread: transitions overwritten before they were read.
    """

    algo = "q"

    def __init__(self, config: LearnerConfig, spaces: Spaces, seed: int, replay: Replay) -> None:
        del seed
        self._config, self._replay = config, replay
        self.architecture = table_architecture(spaces)
        self.gradient_steps = 0
        self.policy_steps = 0
        self.unread = 0
        shape = (spaces.states, spaces.actions)
        self._q: Table = np.full(shape, config.table.initial, np.float64)
        self._visited = np.zeros(shape, np.bool_)
        self._learned_at = np.zeros(shape)  # mean time of the transitions in Q(s, a), weighted as Q has them
        self._next = 0  # number of the first transition not read yet
        self._invalid = 0  # of states or actions that there are not
        self._td_error = 0.0
        self._changed = False  # the policy, since the last `iterate`

    # -- learning

    def update(self, *, improve_policy: bool) -> None:
        """Learn from the transitions not read yet, oldest first; from very many, in several calls.

        Q is learned whether or not the policy is to be improved. With nothing new it does nothing.
        """
        columns = self._replay.read(self._next, _MOST_AT_ONCE)
        oldest = self._replay.added - len(self._replay)
        self.unread += max(0, oldest - self._next)
        self._next = max(oldest, self._next) + len(columns.reward)
        learned = self._learn(columns)
        self.gradient_steps += learned
        if learned and self._follows_q():
            self.policy_steps += learned if improve_policy else 0
            self._changed = True

    def _learn(self, columns: Columns) -> int:
        states, actions = self._q.shape
        read = (columns.observation[:, 0], columns.action[:, 0], columns.next_observation[:, 0])
        known = np.logical_and.reduce(
            [_counts(number, limit) for number, limit in zip(read, (states, actions, states), strict=True)]
        )
        self._invalid += int((~known).sum())
        state, action, following = (number[known].astype(np.int64) for number in read)
        reward, terminated = columns.reward[known].astype(np.float64), columns.terminated[known]
        time = columns.unit[known] + 0.5  # the middle of the unit
        lanes, step_size, gamma = self._q[None], self._config.table.step_size, self._config.gamma
        total = 0.0
        for n in range(len(state)):
            one = slice(n, n + 1)
            delta = q_update(
                lanes, state[one], action[one], reward[one], following[one], terminated[one],
                step_size=step_size, gamma=gamma,
            )  # fmt: skip
            total += abs(float(delta[0]))
            self._note_time((int(state[n]), int(action[n])), float(time[n]))
        if len(state):
            self._td_error = total / len(state)
        return len(state)

    def _note_time(self, at: tuple[int, int], time: float) -> None:
        """Average times with the weights that rewards have in Q(s, a): alpha (1 - alpha)^k, k visits ago."""
        if not self._visited[at]:
            self._visited[at], self._learned_at[at] = True, time
        self._learned_at[at] += self._config.table.step_size * (time - self._learned_at[at])

    def _follows_q(self) -> bool:
        """Whether what is learned moves the policy at once."""
        return True

    def _acting(self) -> Table:
        """The Q that the policy is greedy in."""
        return self._q

    def _age_units(self, unit: int) -> float:
        """Mean age, at the beginning of `unit`, of what the visited Q(s, a) were learned from."""
        return max(0.0, unit - float(self._learned_at[self._visited].mean())) if self._visited.any() else 0.0

    def iterate(self, g: int) -> bool:
        """Say whether the policy changed since this was last asked; Q-learning itself goes on by `update`."""
        del g
        changed, self._changed = self._changed, False
        return changed

    def begin_window(self, window: Window, unit: int) -> None:
        """Q-learning makes no forecast."""

    def outlook(self, start: int, length: int) -> Outlook | None:  # noqa: ARG002 (for subclasses)
        """Q-learning foresees nothing."""
        return None

    def end_unit(self, unit: int) -> None:
        """Q-learning keeps no past tables."""

    # -- reading

    def policy_arrays(self) -> dict[str, NDArray[np.float32]]:
        """The probability of each action in each state, float32 [S, A]."""
        return {"probability": self._policy().astype(np.float32)}

    def _policy(self) -> Table:
        return epsilon_greedy(self._acting(), self._config.table.epsilon)

    def metrics(self) -> dict[str, float]:
        """What the newest update saw, and the table.

        loss/td_error: mean |delta| over the newest update's transitions; q_mean: mean Q(s, a) over what
        was ever visited; entropy: of the policy, mean over states, in nats; table/visited: share of (s, a)
        ever visited; table/unread: transitions overwritten before they were read; table/invalid: of
        states or actions that there are not.
        """
        return {
            "loss/td_error": self._td_error,
            "q_mean": float(self._q[self._visited].mean())
            if self._visited.any()
            else self._config.table.initial,
            "entropy": entropy(self._policy()),
            "table/visited": float(self._visited.mean()),
            "table/unread": float(self.unread),
            "table/invalid": float(self._invalid),
        }

    # -- durability

    def state(self) -> State:
        """Everything needed to go on bit for bit, as copies; the replay is not in it."""
        scalars: dict[str, Any] = {
            "algo": self.algo,
            "states": self.architecture.states,
            "actions": self.architecture.actions,
            "gradient_steps": self.gradient_steps,
            "policy_steps": self.policy_steps,
            "next": self._next,
            "unread": self.unread,
            "invalid": self._invalid,
            "td_error": self._td_error,
            "changed": self._changed,
        }
        return State({name: table.copy() for name, table in self._tables().items()}, scalars)

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        require_fit(state, State(self._expected_tensors(state), self.state().scalars), same=SAME)
        if state.scalars["next"] > self._replay.added:
            read, there = state.scalars["next"], self._replay.added
            raise CheckpointError(f"the checkpoint does not fit: it has read {read} transitions of {there}")
        for name, table in self._tables().items():
            table[...] = state.tensors[name]
        self.gradient_steps = int(state.scalars["gradient_steps"])
        self.policy_steps = int(state.scalars["policy_steps"])
        self._next = int(state.scalars["next"])
        self.unread = int(state.scalars["unread"])
        self._invalid = int(state.scalars["invalid"])
        self._td_error = float(state.scalars["td_error"])
        self._changed = bool(state.scalars["changed"])

    def _tables(self) -> dict[str, NDArray[Any]]:
        """What a checkpoint keeps, by name: themselves, so that `load` writes into them."""
        return {"q": self._q, "visited": self._visited, "learned_at": self._learned_at}

    def _expected_tensors(self, state: State) -> dict[str, NDArray[Any]]:  # noqa: ARG002 (for subclasses)
        """The tensors that `state`, going by its scalars, should have."""
        return self._tables()


def table_architecture(spaces: Spaces) -> Architecture:
    """Of a policy that is a table, in a finite world."""
    return Architecture(
        kind="categorical_table",
        observation_dim=spaces.observation_dim,
        action_dim=spaces.action_dim,
        hidden=[],
        states=spaces.states,
        actions=spaces.actions,
    )


def entropy(policy: Table) -> float:
    """-sum_a pi(a|s) log pi(a|s) in nats, mean over the states; `policy` is [S, A]."""
    surprise = np.log(policy, out=np.zeros_like(policy), where=policy > 0)
    return 0.0 - float((policy * surprise).sum(-1).mean())


def _counts(number: NDArray[np.float32], limit: int) -> NDArray[np.bool_]:
    """Which are whole numbers from 0 to `limit` - 1."""
    whole: NDArray[np.bool_] = (number >= 0) & (number < limit) & (number == np.floor(number))
    return whole
