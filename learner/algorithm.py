"""What the learner's service asks of an algorithm, and which ones there are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from learner.checkpoint import State
from learner.replay import Replay
from learner.schedule.outlook import Outlook
from rtcore.config import DEEP, TABULAR, ConfigError, LearnerConfig, RunConfig
from rtcore.messages import Architecture
from rtcore.spaces import Spaces
from rtcore.windows import Window


class Algorithm(Protocol):
    """A student: learns from the replay, step by step. One thread owns it and its replay.

    Attributes:
        algo: its name in the configuration and in published policies.
        architecture: of the policy that `policy_arrays` gives.
        gradient_steps: made by `update` so far, checkpoints included: one a call, of a table as many as it
            learned transitions.
        policy_steps: how often the policy was improved, by `update` or by `iterate`.
        unread: transitions that were overwritten in the replay before a table could learn from them.
    """

    algo: str
    architecture: Architecture
    gradient_steps: int
    policy_steps: int
    unread: int

    def update(self, *, improve_policy: bool) -> None:
        """One gradient step on one batch: critics and targets, and with `improve_policy` the policy.

        A table learns instead from the transitions that it has not read yet, if there are any.

        Raises:
            ValueError: the replay holds no transition to draw.
        """

    def iterate(self, g: int) -> bool:
        """Iterate g of the window is about to be published, or its time is over: bring the policy there,
        if it is improved unit by unit and not by `update`. Asked again, it does nothing.

        Returns:
            Whether the policy changed.
        """

    def begin_window(self, window: Window, unit: int) -> None:
        """Window m was entered in `unit`, which is t_m unless the learner came late."""

    def outlook(self, start: int, length: int) -> Outlook | None:
        """What can be foreseen of the window of `length` units that begins at t_m = `start`, to choose its
        hold by. Call it after `end_unit(t_m - 1)`, before `begin_window`.

        Returns:
            None where the algorithm forecasts no Q, or has nothing to forecast from yet.
        """

    def end_unit(self, unit: int) -> None:
        """Unit t ended. In the last unit of a window, call this before the next `begin_window`."""

    def policy_arrays(self) -> dict[str, NDArray[np.float32]]:
        """Float32 copies of the policy's parameters, under the names of `rtcore.weights`."""

    def metrics(self) -> dict[str, float]:
        """What the newest update saw. Fetches numbers from tensors, so ask at a display's rate."""

    def state(self) -> State:
        """Everything needed to go on bit for bit, as copies; the replay is not in it."""

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """


def make_algorithm(run: RunConfig, spaces: Spaces, seed: int, replay: Replay) -> Algorithm:
    """The algorithm that `run.learner.algo` names, with fresh networks or tables.

    Raises:
        ConfigError: it does not fit the world's spaces.
    """
    fitting = TABULAR if spaces.finite else DEEP
    if run.learner.algo not in fitting:
        kind = "finite" if spaces.finite else "continuous"
        allowed = f"must be one of {', '.join(fitting)}: {run.env.id} is a {kind} world"
        raise ConfigError("learner.algo", run.learner.algo, allowed)
    make = _make_table if spaces.finite else _make_network
    return make(run, spaces, seed, replay)


def prepare(config: LearnerConfig) -> Callable[[int], None]:
    """Settle how this process computes, once, before `make_algorithm`.

    PyTorch, which takes seconds to load, is loaded only for an algorithm with networks.

    Returns:
        What sets the number of the arithmetic's threads.
    """
    if config.algo in TABULAR:
        return lambda _: None  # numpy, on one thread
    from learner import arithmetic

    arithmetic.prepare(config.threads)
    return arithmetic.set_threads


def _make_table(run: RunConfig, spaces: Spaces, seed: int, replay: Replay) -> Algorithm:
    from learner.tabular.fq import Fq
    from learner.tabular.npg import Npg
    from learner.tabular.q import QLearning
    from learner.tabular.tempo import Tempo

    config = run.learner
    match config.algo:
        case "fq":
            return Fq(config, spaces, seed, replay)
        case "npg":
            return Npg(config, spaces, seed, replay)
        case "tempo":
            return Tempo(config, spaces, seed, replay)
        case _:
            return QLearning(config, spaces, seed, replay)


def _make_network(run: RunConfig, spaces: Spaces, seed: int, replay: Replay) -> Algorithm:
    from learner.deep.fsac import Fsac
    from learner.deep.rsac import Rsac
    from learner.deep.sac import Sac

    config = run.learner
    match config.algo:
        case "fsac":
            return Fsac(config, spaces.observation_dim, spaces.action_dim, seed, replay)
        case "rsac":
            return Rsac(config, spaces, seed, replay, run.env.reward)
        case _:
            return Sac(config, spaces.observation_dim, spaces.action_dim, seed, replay)
