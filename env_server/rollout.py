"""Episodes: from an action in time, or none, to what the world did with the tick. Pure but for the world.

An episode ends when the world says so or after H ticks. The tick after the last is a reset tick: no
transition, no action, no miss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from env_server.actuation import Actuation, Decision, Verdict
from env_server.worlds.world import Outcome, Vector, World
from rtcore.config import Notify
from rtcore.messages import Action

WORLD_STREAM = 0  # keeps the world's random numbers apart from the agent's and the learner's


@dataclass(frozen=True, slots=True)
class Turn:
    """What one tick came to.

    Attributes:
        observation: float32 [observation_dim]: the world's, what is told of the drift (`notify`: no number
            or one), then the observed actions.
        reward: earned over the tick; 0 at a reset.
        terminated: the task ended.
        truncated: only the time limit, or a broken world, ended the episode.
        drift: the drift's true value.
        physics: the factors on mass, friction and gravity; empty where none drifts.
        episode: index, from 0.
        episode_tick: ticks since the reset, 0 at it.
        verdict: what became of the newest message.
        decision: None at a reset.
        episode_return: sum of rewards if the episode ended here, else None.
        broken: the world gave NaN or Inf; observation and reward were replaced.
    """

    observation: Vector
    reward: float
    terminated: bool
    truncated: bool
    drift: float
    physics: tuple[float, ...]
    episode: int
    episode_tick: int
    verdict: Verdict
    decision: Decision | None
    episode_return: float | None
    broken: bool


class Rollout:
    """Turns a world through its episodes, tick by tick."""

    def __init__(
        self,
        world: World,
        actuation: Actuation,
        *,
        episode_steps: int,
        seed: int,
        number: int = 0,
        notify: Notify = "none",
    ) -> None:
        """Episodes are numbered from 0, or from what `go_on_from` says before the first turn; `number` is of
        the environment in a fleet, whose episodes start apart from the others'."""
        self._world = world
        self._notify = notify
        self._actuation = actuation
        self._episode_steps = episode_steps
        self._seed = seed
        self._number = number
        self._episode = -1
        self._episode_tick = 0
        self._return = 0.0
        self._ended = True
        self._last_good: Vector = np.zeros(world.observation_dim, np.float32)

    def go_on_from(self, episode: int) -> None:
        """Number episodes from `episode` on: an earlier life had those before it, and the start of an episode
        follows from its number."""
        self._episode = episode - 1

    def turn(self, newest: Action | None, t: int, *, expected_tick: int) -> Turn:
        """One tick in unit `t`: a reset if the episode has ended, else a step. See `Actuation.decide`."""
        if self._ended:
            return self._reset(newest, t)
        decision = self._actuation.decide(newest, expected_tick=expected_tick)
        outcome = self._world.step(decision.applied, t)
        broken = not (np.isfinite(outcome.observation).all() and np.isfinite(outcome.reward))
        if broken:  # it must not reach anybody's replay: the state before again, and a new episode
            outcome = Outcome(
                self._last_good, 0.0, terminated=False, truncated=True, drift=self._world.drift(t)
            )
        self._last_good = outcome.observation
        self._episode_tick += 1
        self._return += outcome.reward
        over = outcome.truncated or self._episode_tick >= self._episode_steps
        self._ended = outcome.terminated or over
        return Turn(
            observation=self._observed(outcome.observation, t),
            reward=outcome.reward,
            terminated=outcome.terminated,
            truncated=over and not outcome.terminated,
            drift=outcome.drift,
            physics=self._world.physics(t),
            episode=self._episode,
            episode_tick=self._episode_tick,
            verdict=decision.verdict,
            decision=decision,
            episode_return=self._return if self._ended else None,
            broken=broken,
        )

    def answers(self, message: Action, expected_tick: int) -> bool:
        """Whether the message would decide in a turn that is no reset."""
        return self._actuation.answers(message, expected_tick)

    def _reset(self, newest: Action | None, t: int) -> Turn:
        """Begin an episode whose start follows from the seed, the environment's number and the episode's."""
        self._episode += 1
        self._episode_tick = 0
        self._return = 0.0
        # A last 0 changes nothing.
        seeds = np.random.SeedSequence([self._seed, WORLD_STREAM, self._episode, self._number])
        observation = self._world.reset(int(seeds.generate_state(1)[0]), t)
        verdict = self._actuation.reset(newest)
        self._ended = broken = not np.isfinite(observation).all()
        if broken:
            observation = np.zeros_like(observation)
        self._last_good = observation
        return Turn(
            observation=self._observed(observation, t),
            reward=0.0,
            terminated=False,
            truncated=False,
            drift=self._world.drift(t),
            physics=self._world.physics(t),
            episode=self._episode,
            episode_tick=0,
            verdict=verdict,
            decision=None,
            episode_return=None,
            broken=broken,
        )

    def _observed(self, observation: Vector, t: int) -> Vector:
        if self._notify != "none":
            observation = np.append(observation, np.float32(told(self._world, self._notify, t)))
        return self._actuation.observed(observation)


def told(world: World, notify: Notify, t: int) -> float:
    """The number that tells an agent in unit `t` of the drift, where it may know.

    "changed": 1 throughout a unit whose target or physics differ from the unit's before, else 0; NS-Gym calls
    that change notification. "value": the target itself, so that its change is known too (NS-Gym's delta
    change notification tells how much changed).
    """
    if notify == "value":
        return world.drift(t)
    if t == 0:
        return 0.0
    return float((world.drift(t), world.physics(t)) != (world.drift(t - 1), world.physics(t - 1)))
