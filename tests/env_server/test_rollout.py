from __future__ import annotations

import numpy as np
import pytest

from env_server.actuation import Actuation, Rules
from env_server.rollout import Rollout, Turn, told
from env_server.worlds.registry import make_world
from rtcore.config import DriftConfig, EnvConfig, Notify, PhysicsConfig
from rtcore.messages import Action
from tests.env_server.scripted import ScriptedWorld


def make(
    world: ScriptedWorld,
    *,
    episode_steps: int = 4,
    seed: int = 7,
    number: int = 0,
    observe: int = 0,
    notify: Notify = "none",
) -> Rollout:
    rules = Rules(
        on_miss="hold", hold_ticks=1, action_delay_ticks=0, observe_actions=observe, low=world.action_low,
        high=world.action_high, incarnation=1,
    )  # fmt: skip
    return Rollout(
        world, Actuation(rules), episode_steps=episode_steps, seed=seed, number=number, notify=notify
    )


def turns(rollout: Rollout, number: int, t: int = 2) -> list[Turn]:
    """Turns that are all answered in time with the tick's own number of thousandths."""
    result = []
    for tick in range(number):
        values = np.array([tick / 1000], np.float32).tobytes()
        answer = Action(
            env="env0", incarnation=1, tick=max(0, tick - 1), values=values, policy_version=1, received_ns=0,
            sent_ns=0,
        )  # fmt: skip
        result.append(rollout.turn(answer, t, expected_tick=tick - 1))
    return result


def test_an_episode_is_a_reset_and_h_steps_then_truncated() -> None:
    played = turns(make(ScriptedWorld(), episode_steps=3), 9)
    assert [turn.episode for turn in played] == [0, 0, 0, 0, 1, 1, 1, 1, 2]
    assert [turn.episode_tick for turn in played] == [0, 1, 2, 3, 0, 1, 2, 3, 0]
    assert [turn.truncated for turn in played] == [False, False, False, True] * 2 + [False]
    assert not any(turn.terminated for turn in played)
    assert [turn.decision is None for turn in played] == [True, False, False, False] * 2 + [True]
    assert [turn.episode_return for turn in played[:5]] == [None, None, None, 6.0, None]  # 3 steps of t = 2


def test_a_task_that_ends_is_terminated_and_not_truncated() -> None:
    for episode_steps in (2, 10):  # even when the time limit falls on the same tick
        played = turns(make(ScriptedWorld(ends_at=2), episode_steps=episode_steps), 4)
        assert [turn.terminated for turn in played] == [False, False, True, False]
        assert not any(turn.truncated for turn in played)
        assert played[3].episode_tick == 0


def test_the_reset_has_no_reward_but_a_drift() -> None:
    first = turns(make(ScriptedWorld()), 1, t=3)[0]
    assert (first.reward, first.drift, first.decision, first.verdict) == (0.0, 30.0, None, "answer")


def test_resets_are_seeded_by_run_and_episode() -> None:
    seeds = []
    for seed in (7, 7, 8):
        world = ScriptedWorld()
        turns(make(world, episode_steps=1, seed=seed), 6)
        seeds.append(world.seeds)
    assert seeds[0] == seeds[1] != seeds[2]
    assert len(set(seeds[0])) == 3 and None not in seeds[0]


def test_environments_of_a_fleet_start_apart() -> None:
    worlds = [ScriptedWorld() for _ in range(3)]
    for world, number in zip(worlds, (0, 1, 1), strict=True):
        turns(make(world, episode_steps=1, number=number), 6)
    assert worlds[1].seeds == worlds[2].seeds
    assert not set(worlds[0].seeds) & set(worlds[1].seeds)
    assert worlds[0].seeds[0] == int(np.random.SeedSequence([7, 0, 0]).generate_state(1)[0])


def test_decisions_are_appended_to_the_observation() -> None:
    played = turns(make(ScriptedWorld(), observe=2), 4)
    assert played[0].observation.tolist() == [0, 0, 0, 0]
    assert played[3].observation.tolist() == pytest.approx([3, 0.003, 0.003, 0.002])


def test_a_broken_world_reaches_nobody_and_begins_again() -> None:
    world = ScriptedWorld(breaks_at=3)
    played = turns(make(world, episode_steps=10), 6)
    assert [turn.broken for turn in played] == [False, False, False, True, False, False]
    broken = played[3]
    assert broken.observation.tolist() == played[2].observation.tolist()
    assert (broken.reward, broken.terminated, broken.truncated) == (0.0, False, True)
    assert [turn.episode_tick for turn in played] == [0, 1, 2, 3, 0, 1]


@pytest.mark.parametrize(("notify", "number"), [("changed", 1.0), ("value", 20.0)])
def test_what_is_told_stands_between_the_world_and_the_decisions(notify: Notify, number: float) -> None:
    played = turns(make(ScriptedWorld(), observe=1, notify=notify), 4)  # all in unit 2, where the drift is 20
    assert played[0].observation.tolist() == [0, 0, number, 0]  # at a reset too
    assert played[3].observation.tolist() == pytest.approx([3, 0.003, number, 0.003])
    assert played[3].observation.dtype == np.float32


def test_a_broken_world_still_tells() -> None:
    played = turns(make(ScriptedWorld(breaks_at=1), notify="value"), 2)
    assert played[1].broken and played[1].observation.tolist() == [0, 0, 20]


def test_changed_is_one_in_units_that_differ_from_the_one_before() -> None:
    switch = DriftConfig(kind="switch", amplitude=1.0, at=0, every=3)  # 1 1 1 0 0 0 1
    heavy = DriftConfig(kind="switch", offset=1.0, amplitude=1.0, at=4)  # 1 1 1 1 2 2 2
    env = EnvConfig(id="pointmass", drift=switch)
    assert [told(make_world(env, 0), "changed", t) for t in range(7)] == [0, 0, 0, 1, 0, 0, 1]
    env = EnvConfig(id="pointmass", drift=switch, physics=PhysicsConfig(mass=heavy))
    assert [told(make_world(env, 0), "changed", t) for t in range(7)] == [0, 0, 0, 1, 1, 0, 1]
    assert [told(make_world(env, 0), "value", t) for t in range(7)] == [1, 1, 1, 0, 0, 0, 1]
