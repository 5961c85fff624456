"""rtgym's own real-time loop around a world that costs nothing, once, as a line of JSON.

    python -m benchmarks.rtgym_world --variant v1 --hz 500 --seconds 10

The user's side of the loop is our policy's inference for a HalfCheetah observation. rtgym applies an
action at the end of the time step in which it was computed, so the instants of its `send_control` are
what our deadlines are: the world's step under the next action begins there.
"""

from __future__ import annotations

import json
import sys
import warnings
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import gymnasium
import numpy as np
import rtgym
import tyro
from numpy.typing import NDArray

from agent_service.inference import TanhGaussianPolicy
from benchmarks.harness import LATE_SHARE, policy
from benchmarks.outcome import Outcome
from benchmarks.peer_loop import ACTION_DIM, HIDDEN, OBSERVATION_DIM
from launcher.quantiles import quantiles_us
from launcher.stealing import StealMeter
from rtcore import channels, realtime
from rtcore.monotonic import MonotonicClock
from rtcore.spaces import Spaces
from rtcore.weights import verify

Variant = Literal["v1", "ts-v1"]  # a thread per step, or one thread for all
Nanoseconds = NDArray[np.int64]


@dataclass(frozen=True)
class Arguments:
    """Which of its loops, and how fast."""

    variant: Variant = "v1"
    hz: float = 100.0
    seconds: float = 10.0
    rt: realtime.Rt = "auto"


class Still(rtgym.RealTimeGymInterface):  # type: ignore[misc]  # it has no types
    """A world that is always the same; it notes when it is controlled."""

    def __init__(self, controlled_ns: array[int], now_ns: Callable[[], int]) -> None:
        self._controlled_ns = controlled_ns
        self._now_ns = now_ns
        self._observation = np.linspace(-1, 1, OBSERVATION_DIM).astype(np.float32)

    def send_control(self, control: Any) -> None:
        """Note the instant."""
        del control
        self._controlled_ns.append(self._now_ns())

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[list[Any], dict[str, Any]]:
        """The observation, once more."""
        del seed, options
        return [self._observation], {}

    def get_obs_rew_terminated_info(self) -> tuple[list[Any], float, bool, dict[str, Any]]:
        """The observation."""
        return [self._observation], 0.0, False, {}

    def get_observation_space(self) -> gymnasium.spaces.Tuple[Any]:
        """HalfCheetah's size."""
        return gymnasium.spaces.Tuple(
            (gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM,), np.float32),)
        )

    def get_action_space(self) -> gymnasium.spaces.Box:
        """HalfCheetah's size."""
        return gymnasium.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

    def get_default_action(self) -> NDArray[np.float32]:
        """No torque."""
        return np.zeros(ACTION_DIM, np.float32)


def pacing_errors(instants_ns: Nanoseconds, period_ns: int, restarts: Sequence[int]) -> Nanoseconds:
    """How late each control was on the clock's own grid.

    rtgym keeps its grid private, so a grid is laid through the most punctual control of each stretch:
    this flatters it by that one's lateness.

    Args:
        instants_ns: when the world was controlled, in order.
        period_ns: of the grid.
        restarts: indices of controls from which on the clock was set anew, in order.
    """
    bounds = [0, *restarts, len(instants_ns)]
    parts = []
    for begin, end in pairwise(bounds):
        offset = instants_ns[begin:end] - np.arange(end - begin) * period_ns
        if len(offset):
            parts.append(offset - offset.min())
    return np.concatenate(parts) if parts else np.empty(0, np.int64)


@contextmanager
def timeouts(controlled_ns: array[int]) -> Iterator[list[int]]:
    """The indices of controls at which rtgym warned that a time step had timed out and set its clock anew."""
    found: list[int] = []

    def note(message: Warning | str, *_: Any, **__: Any) -> None:
        if "timed out" in str(message):
            found.append(max(0, len(controlled_ns) - 1))  # it warns right after the control

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = note
        yield found


def make_actor() -> Callable[[Any], NDArray[np.float32]]:
    """Our inference."""
    made = policy(OBSERVATION_DIM, ACTION_DIM, HIDDEN)
    bound = np.ones(ACTION_DIM, np.float32)
    weights = verify(made, Spaces(OBSERVATION_DIM, ACTION_DIM))
    actor = TanhGaussianPolicy(1, made.architecture, weights, -bound, bound)
    rng = np.random.default_rng(0)
    actor.act(np.zeros(OBSERVATION_DIM, np.float32), rng)  # the first one is slow
    return lambda observation: actor.act(observation[0], rng)


def run(arguments: Arguments) -> Outcome:
    """Step the environment for so many seconds."""
    placement = realtime.enter(channels.ENV_SERVER, arguments.rt)
    clock, act = MonotonicClock(), make_actor()
    period_s = 1 / arguments.hz
    instants: array[int] = array("q")
    settings = rtgym.DEFAULT_CONFIG_DICT | {
        "interface": Still,
        "interface_args": (instants, clock.now_ns),
        "time_step_duration": period_s,
        "start_obs_capture": period_s,
    }
    env: gymnasium.Env[Any, Any] = gymnasium.make(
        f"real-time-gym-{arguments.variant}", config=settings, disable_env_checker=True
    )
    steal = StealMeter()
    with timeouts(instants) as restarts:
        observation, _ = env.reset()
        begin_ns = clock.now_ns()
        steps = 0
        while clock.now_ns() - begin_ns < arguments.seconds * 1e9:
            observation, *_ = env.step(act(observation))
            steps += 1
        span_s = (clock.now_ns() - begin_ns) / 1e9
        env.get_wrapper_attr("wait")()  # the last time step ends
    pacing = pacing_errors(np.array(instants, np.int64), round(1e9 * period_s), restarts)
    return Outcome(
        ticks=steps,
        missed=len(restarts),
        overruns=len(restarts),
        loop_us=quantiles_us(np.empty(0, np.int64)),
        pacing_us=quantiles_us(pacing),
        stolen_s=steal.elapsed_s(),
        more={
            "rate_hz": steps / span_s,
            "late_share": float(np.mean(pacing > LATE_SHARE * 1e9 * period_s)),
            "placement": placement.describe(),
        },
    )


def main(arguments: Arguments) -> None:
    """Measure and print."""
    sys.stdout.write(json.dumps(run(arguments).as_dict()) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
