"""The configuration of a whole run: one frozen section per process, validated once.

A run is described by one `RunConfig`. Presets are functions that return one; the command line
overrides fields; `run.toml` keeps the resolved one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

DriftKind = Literal[
    "none", "constant", "sine", "ramp", "square", "switch", "random_walk", "ou", "noise", "burst", "recorded"
]
Notify = Literal["none", "changed", "value"]
Algo = Literal["sac", "fsac", "rsac", "q", "fq", "npg", "tempo"]
TABULAR: tuple[Algo, ...] = ("q", "fq", "npg", "tempo")  # for finite worlds
DEEP: tuple[Algo, ...] = ("sac", "fsac", "rsac")  # for continuous ones
Basis = Literal["constant", "identity", "polynomial", "fourier"]
MissPolicy = Literal["hold", "neutral", "hold_then_neutral"]
ScheduleKind = Literal["fixed", "explicit", "optimal", "auto", "auto_bound", "live"]
Rounding = Literal["floor", "ceil", "paper_le"]
Precision = Literal["float32", "bfloat16", "auto"]


@dataclass(frozen=True, kw_only=True)
class DriftConfig:
    """How a quantity moves with the unit t (`env_server.worlds.drift` has each kind's formula)."""

    kind: DriftKind = "sine"
    offset: float = 0.0  # where it moves around, or starts from
    amplitude: float = 0.0  # how far it moves: sine, square, ramp, switch, burst; either way
    omega: float = 0.0  # sine, square: radians per unit
    phase: float = 0.0  # sine, square: radians
    at: float | Literal["random"] = 0.0  # ramp, switch, burst: the unit it begins in; or drawn from [0, span)
    span: float = 1.0  # ramp, burst: how many units it takes; switch: see `at`
    every: float = 0.0  # switch: back and forth after so many units; burst: again, > span; 0: once
    rate: float = 0.1  # ou: pull towards the offset, per unit
    sd: float = 0.0  # random_walk, ou, noise: standard deviation of a unit's step
    low: float | None = None  # bounds of the value, of any kind but none; a walk goes on beyond, unseen
    high: float | None = None
    seed: int | None = None  # of what is random; None: the run's seed
    path: str = ""  # recorded: a CSV file with the columns "unit" and "value"; a value holds until the next

    @property
    def still(self) -> bool:
        """Whether the value is 0 in every unit."""
        if self.kind in ("none", "recorded"):
            return self.kind == "none"
        walks = self.kind in ("random_walk", "ou", "noise")
        moves = 0.0 if self.kind == "constant" else self.sd if walks else self.amplitude
        return not (self.offset or moves or (self.low or 0.0) > 0 or (self.high or 0.0) < 0)


def _still() -> DriftConfig:
    return DriftConfig(kind="none")


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """Drift of the dynamics: each a factor on what the world was built with; kind "none" leaves it alone.

    So `offset` is usually 1. A mass never gets below 0.05 of its own, the others not below 0.
    """

    mass: DriftConfig = field(default_factory=_still)
    friction: DriftConfig = field(default_factory=_still)
    gravity: DriftConfig = field(default_factory=_still)


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Drifting worlds: healthy - |k_f * v - v_d(t)| - control_cost * |a|^2 (paper, appendix C.1)."""

    k_f: float = 1.0  # weight of the speed v in m/s, > 0
    control_cost: float = 0.1  # weight of the squared action norm
    healthy: float = 0.0  # Gymnasium has none for HalfCheetah and Swimmer


@dataclass(frozen=True, kw_only=True)
class CliffConfig:
    """What the paper leaves open about its cliffworld (section 6.2, appendix); see docs/cliffworld.md."""

    pays: Literal["arrive", "leave"] = "leave"  # the reward of a cell comes on entering or on leaving it
    inactive_goal: Literal["ordinary", "terminal"] = "terminal"
    step_reward: float = -1.0  # the paper prints -100, what falling costs
    goal_reward: float = 100.0
    restart_reward: float = -100.0


@dataclass(frozen=True, kw_only=True)
class MdpConfig:
    """A random finite MDP between two ends, A and B; the drift w in [0, 1] says how far it is from A to B."""

    states: int = 6
    actions: int = 3
    concentration: float = 0.3  # of the Dirichlet rows of P: small is nearly deterministic
    drifting: Literal["reward", "dynamics", "both"] = "reward"
    slip: float = 0.0  # chain: probability of a step the other way


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """The world and its clock."""

    id: str = "HalfCheetah-v5"  # a world of ours or any Gymnasium id
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
    start_wait_s: float = 15.0  # T0 waits so long, at most, for the others to be there
    notify: Notify = "none"  # told of the drift, as a number after the world's observation: 1 in a unit
    # in which target or physics changed, else 0; or the target's value
    drift: DriftConfig = field(default_factory=DriftConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    cliff: CliffConfig = field(default_factory=CliffConfig)
    mdp: MdpConfig = field(default_factory=MdpConfig)


@dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """The actor."""

    rt: Literal["auto", "off", "require"] = "auto"  # real-time scheduling of env server and agent


@dataclass(frozen=True, kw_only=True)
class BoundConfig:
    """The constants of the paper's bound (section 5), for the optimal schedule; `tenuto plan` finds them."""

    c_1: float = 1.0  # C_1, the policy's distance from the optimal one as a window begins
    c_45: float = 1.0  # C_4 + C_5, what a change of the world costs
    eta: float = 0.1  # step size and
    tau: float = 0.1  # entropy weight of the policy's update
    alpha_1: float = 1.05  # growth of the variation budget per unit, in the update; above 1 (Assumption 1)
    alpha_2: float = 1.05  # and in the hold
    b_1: float = 1.0  # B^max of the update
    b_2: float = 1.0  # and of the hold


@dataclass(frozen=True, kw_only=True)
class ScheduleConfig:
    """When the policy is updated and when it is held (paper, section 3)."""

    kind: ScheduleKind = "fixed"
    l_f: int = 10  # units per window; live: 1 whatever is given here
    gamma_f: float = 0.7  # share of a window that is updated in; auto: while too little is known
    rounding: Rounding = "floor"
    t_m: tuple[int, ...] = ()  # window starts in units, explicit schedule; the first is 0
    g_m: tuple[int, ...] = ()  # update units of each, explicit schedule
    least_update: int = 1  # auto, auto_bound: units of a window that are updated in whatever is predicted
    least_gain: float = 0.05  # auto: hold only if that is predicted to save this share (docs/headline.md)
    rate: float = 0.1  # auto with fsac: share of the way to its target that a unit takes the policy
    bound: BoundConfig = field(default_factory=BoundConfig)


@dataclass(frozen=True, kw_only=True)
class ForecastConfig:
    """ForQ: the Q function of the next window from past critics (paper, section 6.1)."""

    kind: Literal["none", "forq"] = "forq"
    l_p: int = 10  # past Q functions
    every: int = 1  # units between them
    basis: Basis = "identity"
    degree: int = 2  # polynomial: its degree
    period: float = 100.0  # fourier: of the slowest wave, in units
    harmonics: int = 1  # fourier: waves of period / 1 .. period / harmonics
    horizon: float | Literal["window", "replay"] = "window"  # units ahead of t_m; "window": its length, as in
    # the paper; "replay": also the mean age of what the Q functions are learned from
    shrink: float = 0.0  # added to the slopes' normal equations, in units^2; >= 0
    trust: Literal["always", "judged", "never"] = "always"
    parity: Literal["none", "authors"] = "none"  # "authors": the past critics are aliases of the live one
    distil: bool = False  # fit one network to the forecast at t_m, and improve the policy against that


@dataclass(frozen=True, kw_only=True)
class RewardModelConfig:
    """rsac: what the drift of the reward is fitted with, and how it is forecast."""

    model: Literal["declared", "learned"] = "declared"  # the family of `env.reward`, or a network
    speed_entry: int = 0  # declared: which entry of the observation is the speed v
    forecast: Literal["best", "persistence", "line", "level", "ar"] = "best"  # persistence: relabelling alone
    hidden: tuple[int, ...] = (32, 32)  # learned
    lr: float = 3e-3  # learned: of the network
    latent_lr: float = 2e-2  # learned: of the units' latents


@dataclass(frozen=True, kw_only=True)
class TableConfig:
    """q, fq, npg and tempo: what is kept in tables."""

    step_size: float = 0.1  # alpha of Q-learning
    epsilon: float = 0.1  # share of uniformly random actions
    initial: float = 0.0  # of every Q
    eta: float = 0.1  # npg: learning rate of the policy
    entropy: float = 0.1  # npg: tau, the weight of the entropy
    write_back: float = 0.0  # fq: share of the forecast that is written into Q at the start of a window
    tempo_begin: int = 0  # tempo: the unit in which beta begins to rise from 0
    tempo_span: int = 10  # tempo: units until it is 1


@dataclass(frozen=True, kw_only=True)
class LearnerConfig:
    """The student."""

    algo: Algo = "sac"
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
    replay_recency: float | None = None  # sample by age, exponential with this mean in units; None: uniform
    value_network: bool = False  # critics learn towards a V network, as in Algorithm 2, not target critics
    threads: int = 1
    precision: Precision = "auto"  # of the networks' products, "auto": bfloat16 where the processor has it
    governor: Literal["on", "off"] = "on"  # give way to the agent before deadlines are missed
    checkpoint_s: float = 10.0  # between checkpoints, each at a unit's end; what a kill -9 loses at most
    on_mismatch: Literal["refuse", "fresh"] = "refuse"  # a checkpoint that does not fit: end, or set it aside
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    forecast: ForecastConfig = field(default_factory=ForecastConfig)
    reward: RewardModelConfig = field(default_factory=RewardModelConfig)
    table: TableConfig = field(default_factory=TableConfig)


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
    secure: str = ""  # directory of this host's keys and certificates; "": nothing is secured


@dataclass(frozen=True, kw_only=True)
class SuperviseConfig:
    """When a process that died is started again."""

    limit: int = 10  # deaths of one process in a row after which the run is given up
    within_s: float = 60.0  # a life that lasted so long begins the row anew
    first_s: float = 0.1  # from a death to the next start, then twice as long each time
    most_s: float = 5.0  # at most
    stuck_s: float = 8.0  # a process whose loop has not turned for so long is killed and started again


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
    supervise: SuperviseConfig = field(default_factory=SuperviseConfig)


class ConfigError(ValueError):
    """A wrong value: names the field, the value and what is allowed, on one line."""

    def __init__(self, name: str, value: object, allowed: str) -> None:
        super().__init__(f"{name} = {value!r}: {allowed}")
        self.name, self.value, self.allowed = name, value, allowed
