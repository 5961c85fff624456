"""How the env server puts things into messages. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from env_server.accounts import Latency
from env_server.rollout import Turn
from env_server.worlds.world import Position, World
from rtcore.config import EnvConfig
from rtcore.epoch import Epoch
from rtcore.messages import Spec, Step
from rtcore.pacer import Tick


@dataclass(frozen=True, slots=True)
class Stamp:
    """Whose step it is, and which: the fields of `Step` of these names."""

    env: str
    incarnation: int
    seq: int
    unit: int
    sent_ns: int


def word_spec(env: EnvConfig, world: World, epoch: Epoch, *, incarnation: int, tick_ns: int) -> Spec:
    """The declaration of a resolved `env` in a run that began at `epoch`."""
    simulated_s = 0.0 if env.speed is None else env.speed * tick_ns / 1e9
    return Spec(
        env=env.name,
        env_id=env.id,
        incarnation=incarnation,
        t0_ns=epoch.t0_ns,
        wall_t0_ns=epoch.wall_t0_ns,
        tick_ns=tick_ns,
        unit_ns=unit_ns(env),
        observation_dim=observation_dim(env, world),
        action_dim=world.action_dim,
        action_low=world.action_low.tolist(),
        action_high=world.action_high.tolist(),
        action_delay_ticks=env.action_delay_ticks,
        native_period_ns=round(simulated_s * 1e9),
        scene=world.scene,
        states=world.states,
        actions=world.actions,
        host=epoch.boot_id,
    )


def word_step(stamp: Stamp, tick: Tick, turn: Turn, latency: Latency, position: Position) -> Step:
    """The report of one executed tick, without a miss's cause; `latency` is that of the newest answer."""
    in_time, late = (latency, Latency()) if turn.verdict == "answer" else (Latency(), latency)
    decision = turn.decision
    return Step(
        env=stamp.env,
        incarnation=stamp.incarnation,
        seq=stamp.seq,
        tick=tick.index,
        episode=turn.episode,
        episode_tick=turn.episode_tick,
        unit=stamp.unit,
        due_ns=tick.due_ns,
        woke_ns=tick.woke_ns,
        sent_ns=stamp.sent_ns,
        observation=turn.observation.astype("<f4").tobytes(),
        reward=turn.reward,
        terminated=turn.terminated,
        truncated=turn.truncated,
        action=b"" if decision is None else decision.applied.astype("<f4").tobytes(),
        decision=b"" if decision is None else decision.decided.astype("<f4").tobytes(),
        answered_tick=-1 if decision is None else decision.answered_tick,
        policy_version=-1 if decision is None else decision.policy_version,
        missed=decision is not None and decision.missed,
        fallback="" if decision is None else decision.fallback,
        cause="",
        skipped=tick.skipped,
        loop_ns=in_time.loop_ns,
        reaction_ns=in_time.reaction_ns,
        late_loop_ns=late.loop_ns,
        late_reaction_ns=late.reaction_ns,
        drift=turn.drift,
        position=position.astype("<f8").tobytes(),
        physics=list(turn.physics),
    )


def observation_dim(env: EnvConfig, world: World) -> int:
    """Numbers in a step's observation: the world's, one if `notify` tells of the drift, observed actions."""
    return world.observation_dim + (env.notify != "none") + env.observe_actions * world.action_dim


def unit_ns(env: EnvConfig) -> int:
    """The length of a unit t."""
    return round(env.unit_s * 1e9)
