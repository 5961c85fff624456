"""What acts at a deadline: the answer that came in time, or the declared fallback. Pure.

At D_k the answer to the newest observation (that of the tick executed before) becomes the decision;
without one the tick is a miss and the fallback decides. The decision enters a delay line and acts
`action_delay_ticks` ticks later, at once without delay. Older answers never act.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from env_server.worlds.world import Vector, World
from rtcore.config import EnvConfig, MissPolicy
from rtcore.messages import Action, Fallback

Verdict = Literal["none", "answer", "stale", "invalid"]

_CLIP_TOLERANCE = 1e-6  # of the range: what float32 scaling of [-1, 1] may overshoot without being a fault


@dataclass(frozen=True, kw_only=True)
class Rules:
    """What `Actuation` obeys; the first four fields are those of `EnvConfig`, the last but one the world's.

    An action is neutral that is zero, or as near to it as the bounds allow: in a finite world action 0.
    """

    on_miss: MissPolicy
    hold_ticks: int
    action_delay_ticks: int
    observe_actions: int
    low: Vector
    high: Vector
    actions: int = 0  # of a finite world; 0: continuous
    incarnation: int

    @staticmethod
    def of(env: EnvConfig, world: World, *, incarnation: int) -> Rules:
        """The rules of one environment."""
        return Rules(
            on_miss=env.on_miss,
            hold_ticks=env.hold_ticks,
            action_delay_ticks=env.action_delay_ticks,
            observe_actions=env.observe_actions,
            low=world.action_low,
            high=world.action_high,
            actions=world.actions,
            incarnation=incarnation,
        )


@dataclass(frozen=True, slots=True)
class Decision:
    """One deadline's result.

    Attributes:
        applied: float32 [action_dim], read-only, acts over the tick.
        decided: float32 [action_dim], read-only, enters the delay line; the same as `applied` without delay.
        missed: no answer to the newest observation came.
        fallback: what decided instead of an answer; "" if not missed.
        policy_version: behind `decided`; -1 for the neutral action.
        answered_tick: tick of the observation that `decided` answered; -1 for the neutral action.
        verdict: what became of the newest message.
        clipped: the answer lay outside the bounds.
    """

    applied: Vector
    decided: Vector
    missed: bool
    fallback: Fallback
    policy_version: int
    answered_tick: int
    verdict: Verdict
    clipped: bool


@dataclass(frozen=True, slots=True)
class _Choice:
    """A decision's values and where they come from."""

    values: Vector
    policy_version: int
    answered_tick: int


class Actuation:
    """Decides tick by tick. Remembers the last decisions of the episode."""

    def __init__(self, rules: Rules) -> None:
        self._rules = rules
        neutral = np.clip(np.zeros_like(rules.low), rules.low, rules.high)
        neutral.setflags(write=False)  # decisions are shared: by hold, delay line and observed actions
        self._neutral = _Choice(neutral, -1, -1)
        self._held: _Choice | None = None
        self._missed_in_a_row = 0
        self._line: deque[Vector] = deque()
        self._past: deque[Vector] = deque()
        self._start()

    def reset(self, newest: Action | None) -> Verdict:
        """Begin an episode at this tick: neutral actions in the delay line, nothing to hold.

        Args:
            newest: the message that came since the tick before, if any; it has nothing to act on.

        Returns:
            "answer" or "none": an answer to the episode's last observation is nobody's fault.
        """
        self._start()
        return "none" if newest is None else "answer"

    def decide(self, newest: Action | None, *, expected_tick: int) -> Decision:
        """The deadline of one tick that is no reset.

        Args:
            newest: the newest message that came since the tick before, if any.
            expected_tick: the tick executed before this one, whose observation is to be answered.
        """
        verdict, answer, clipped = self._judge(newest, expected_tick)
        fallback: Fallback = ""
        if answer is not None:
            self._held, self._missed_in_a_row = answer, 0
            choice = answer
        else:
            fallback, choice = self._fall_back()
            self._missed_in_a_row += 1
        self._line.append(choice.values)
        if self._past:
            self._past.appendleft(choice.values)
        return Decision(
            applied=self._line.popleft(),
            decided=choice.values,
            missed=answer is None,
            fallback=fallback,
            policy_version=choice.policy_version,
            answered_tick=choice.answered_tick,
            verdict=verdict,
            clipped=clipped,
        )

    def answers(self, message: Action, expected_tick: int) -> bool:
        """Whether the message would decide."""
        return self._judge(message, expected_tick)[0] == "answer"

    def observed(self, observation: Vector) -> Vector:
        """`observation` followed by the last `observe_actions` decisions, newest first; neutral ones before
        the episode's first.

        Returns:
            float32 [observation_dim + observe_actions * action_dim].
        """
        return np.concatenate((observation, *self._past)) if self._past else observation

    def _start(self) -> None:
        rules, neutral = self._rules, self._neutral.values
        self._held = None
        self._missed_in_a_row = 0
        self._line = deque([neutral] * rules.action_delay_ticks)
        self._past = deque([neutral] * rules.observe_actions, maxlen=rules.observe_actions)

    def _judge(self, newest: Action | None, expected_tick: int) -> tuple[Verdict, _Choice | None, bool]:
        """What the message is, the choice it makes if it is the answer, and whether it had to be clipped."""
        rules = self._rules
        if newest is None:
            return "none", None, False
        if newest.incarnation != rules.incarnation or newest.tick < expected_tick:
            return "stale", None, False
        if newest.tick > expected_tick or len(newest.values) != rules.low.nbytes:
            return "invalid", None, False
        wanted = np.frombuffer(newest.values, "<f4").astype(np.float32)
        if not (np.isfinite(wanted).all() and self._exists(wanted)):
            return "invalid", None, False
        values = np.clip(wanted, rules.low, rules.high)
        values.setflags(write=False)
        clipped = bool((np.abs(wanted - values) > _CLIP_TOLERANCE * (rules.high - rules.low)).any())
        return "answer", _Choice(values, newest.policy_version, newest.tick), clipped

    def _exists(self, wanted: Vector) -> bool:
        """Whether a finite world has this action. There is nothing to clip: the nearest number is any other
        action."""
        actions = self._rules.actions
        return actions == 0 or bool(((wanted >= 0) & (wanted < actions) & (wanted == np.floor(wanted))).all())

    def _fall_back(self) -> tuple[Fallback, _Choice]:
        rules = self._rules
        run_out = rules.on_miss == "hold_then_neutral" and self._missed_in_a_row >= rules.hold_ticks
        if rules.on_miss == "neutral" or run_out or self._held is None:
            return "neutral", self._neutral
        return "hold", self._held
