"""The configuration of a whole run: one frozen section per process, validated once.

A run is described by one `RunConfig`. Presets are functions that return one; the command line
overrides fields; `run.toml` keeps the resolved one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

DriftKind = Literal["none", "constant", "sine"]
MissPolicy = Literal["hold", "neutral", "hold_then_neutral"]
ScheduleKind = Literal["fixed", "explicit"]
Rounding = Literal["floor", "ceil", "paper_le"]
Precision = Literal["float32", "bfloat16", "auto"]


@dataclass(frozen=True, kw_only=True)
class DriftConfig:
    """How the target moves with the unit t: offset, or offset + amplitude * sin(omega * t + phase)."""

    kind: DriftKind = "sine"
    offset: float = 0.0
    amplitude: float = 0.0
    omega: float = 0.0  # radians per unit
    phase: float = 0.0  # radians


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Drifting worlds: healthy - |k_f * v - v_d(t)| - control_cost * |a|^2 (paper, appendix C.1)."""

    k_f: float = 1.0  # weight of the speed v in m/s, > 0
    control_cost: float = 0.1  # weight of the squared action norm
    healthy: float = 0.0  # Gymnasium has none for HalfCheetah and Swimmer


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """The world and its clock."""

    id: str = "HalfCheetah-v5"  # "pointmass" or any Gymnasium id
    name: str = "env0"  # in the keys and in every step
    hz: float | None = None  # wall-clock control rate; derived from speed when not given
    speed: float | None = None  # times faster than native; derived from hz when not given
    episode_steps: int = 200  # H; the episode is truncated after so many ticks
    unit_s: float = 1.0  # seconds per unit t
    action_delay_ticks: int = 0
    observe_actions: int = 0  # how many of the last decisions are appended to the observation
    on_miss: MissPolicy = "hold"
    hold_ticks: int = 5  # for hold_then_neutral: held so many ticks, then neutral
    count: int = 1
    start_wait_s: float = 15.0  # T0 waits so long, at most, for an agent and a learner to be there
    drift: DriftConfig = field(default_factory=DriftConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)


@dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """The actor."""

    rt: Literal["auto", "off", "require"] = "auto"  # real-time scheduling of env server and agent


@dataclass(frozen=True, kw_only=True)
class ScheduleConfig:
    """When the policy is updated and when it is held (paper, section 3)."""

    kind: ScheduleKind = "fixed"
    l_f: int = 10  # units per window, fixed schedule
    gamma_f: float = 0.7  # share of a window in which the policy is updated
    rounding: Rounding = "floor"
    t_m: tuple[int, ...] = ()  # window starts in units, explicit schedule; the first is 0
    g_m: tuple[int, ...] = ()  # update units of each, explicit schedule


@dataclass(frozen=True, kw_only=True)
class ForecastConfig:
    """ForQ: the Q function of the next window from past critics (paper, section 6.1)."""

    kind: Literal["none", "forq"] = "forq"
    l_p: int = 10  # past critics, one per unit
    basis: Literal["constant", "identity"] = "identity"
    horizon: float | None = None  # units ahead of t_m; None: the window's length
    shrink: float = 0.0  # added to the slope's normal equation, in units^2; >= 0
    trust: Literal["always", "never"] = "always"
    distil: bool = False  # fit one network to the forecast at t_m, and improve the policy against that


@dataclass(frozen=True, kw_only=True)
class LearnerConfig:
    """The student."""

    algo: Literal["sac", "fsac"] = "sac"
    utd: float = 1.0  # gradient steps per transition, at most
    hold_learning: Literal["full", "half", "off"] = "full"  # the critics' share of the hold phase
    learning_starts: int = 500  # transitions before the first gradient step
    hidden: tuple[int, ...] = (256, 256)
    batch: int = 256
    gamma: float = 0.99
    tau: float = 0.005  # soft update of the target critics
    actor_lr: float = 3e-4
    critic_lr: float = 3e-4
    alpha: float | Literal["auto"] = "auto"  # entropy temperature, or tuned to target_entropy
    alpha_lr: float = 3e-4
    target_entropy: float | None = None  # None: minus the action dimension
    replay_capacity: int = 1_000_000  # transitions
    replay_units: float | None = None  # sample only the newest units; None: all
    threads: int = 1
    precision: Precision = "auto"  # of the networks' products, "auto": bfloat16 where the processor has it
    governor: Literal["on", "off"] = "on"  # give way to the agent before deadlines are missed
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    forecast: ForecastConfig = field(default_factory=ForecastConfig)


@dataclass(frozen=True, kw_only=True)
class RecorderConfig:
    """The witness."""

    record: bool = True
    detail: Literal["full", "light"] = "full"  # light: no 3-D, scalars only
    view: Literal["none", "web", "native"] = "none"
    port: int = 9876  # of the live stream, on 127.0.0.1


@dataclass(frozen=True, kw_only=True)
class LinkConfig:
    """How the processes reach each other."""

    connect: tuple[str, ...] = ()  # extra endpoints to connect to
    listen: tuple[str, ...] = ()  # extra endpoints to listen on


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """One run, whole."""

    preset: str = "custom"
    seed: int = 0
    duration_s: float = 120.0  # of run time, from T0; 0: until stopped
    env: EnvConfig = field(default_factory=EnvConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    recorder: RecorderConfig = field(default_factory=RecorderConfig)
    link: LinkConfig = field(default_factory=LinkConfig)


class ConfigError(ValueError):
    """A wrong value: names the field, the value and what is allowed, on one line."""

    def __init__(self, name: str, value: object, allowed: str) -> None:
        super().__init__(f"{name} = {value!r}: {allowed}")
        self.name = name
