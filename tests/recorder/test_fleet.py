"""A recording of several environments: each has its own rows, all have one file, one learner, one clock."""

from __future__ import annotations

from pathlib import Path

import pytest

from recorder import reading
from recorder.place import ENV_BYTES, SLOT_BYTES
from rtcore.messages import Event
from tests.recorder.fleet_stage import Fleet, set_fleet, tick_of, ticks
from tests.recorder.stage import (
    MS,
    SPEC,
    T0,
    TICK,
    UNIT,
    Stage,
    come_back,
    drain,
    make_notice,
    make_policy,
    make_stats,
    make_step,
    set_stage,
)

TIMELINES = {"run_time", "wall", "tick", "episode", "unit"}


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """120 ticks of three environments with a miss in the last one, a window, a policy, all processes."""
    fleet = set_fleet(tmp_path_factory.mktemp("told"), 3)
    stage = fleet.stage
    fleet.declare("env0", "env1", "env2")
    stage.window.put(make_notice(0, "update", T0))
    fleet.play(range(60), "env0", "env1", "env2")
    stage.policy.put(make_policy(1, T0 + UNIT))
    late = make_step(60, missed=True, cause="agent_late")
    for env in ("env0", "env1", "env2"):
        fleet.send(env, [late if env == "env2" else tick_of(env, 60)])
    fleet.play(range(61, 120), "env0", "env1", "env2", last=True)
    for process in ("agent_service.2", "env_server.0", "learner"):
        event = Event(at_ns=T0 + UNIT, level="INFO", text=f"{process}: core 1")
        stage.stats(make_stats(process, 0, T0 + UNIT, events=[event], gauges={"alpha": 0.5}))
    stage.service.close()
    return stage


def test_each_environment_has_its_own_entities_and_the_learner_its_one(told: Stage) -> None:
    own = {
        "env/reward", "env/return", "env/drift", "env/pacing_us", "agent/loop_us", "agent/reaction_us",
        "agent/policy_version", "agent/missed", "world/point", "world/follow", "world/ground",
    }  # fmt: skip
    shared = {"/learner/phase", "/learner/published_version", "/learner/alpha", "/log", "/run_card"}
    of_envs = {f"/env{i}/{entity}" for i in range(3) for entity in own} | {"/env2/agent/missed/agent_late"}
    assert set(reading.entities(told.path)) == of_envs | shared
    assert reading.env_roots(told.path) == ["/env0", "/env1", "/env2"]
    for entity in reading.entities(told.path):
        if "ground" not in entity and entity != "/run_card":
            assert reading.timelines(told.path, entity) == TIMELINES, entity


def test_each_environments_rows_are_complete_and_its_own(told: Stage) -> None:
    for number, root in enumerate(reading.env_roots(told.path)):
        at, reward = reading.columns(told.path, f"{root}/env/reward", timeline="run_time")
        assert at.tolist() == [seq * TICK for seq in range(120)]  # one T0
        expected = [tick_of(f"env{number}", seq).reward for seq in range(120)]
        if number == 2:
            expected[60] = make_step(60).reward
        assert reward[:, 0].tolist() == expected
        _, places = reading.columns(told.path, f"{root}/world/point", reading.TRANSLATION)
        assert places[0, 0] == pytest.approx(number)
    assert reading.columns(told.path, "/env1/env/return")[0].tolist() == list(range(14, 120, 15))
    assert reading.columns(told.path, "/env1/env/return", timeline="episode")[0].tolist() == list(range(8))
    assert reading.columns(told.path, "/env1/agent/missed")[1].sum() == 0
    assert reading.columns(told.path, "/env2/agent/missed")[1].sum() == 1


def test_series_that_share_a_view_have_the_names_of_their_environments(told: Stage) -> None:
    assert reading.series(told.path, "/env1/env/reward") == ["env1"]
    assert reading.series(told.path, "/env2/env/drift") == ["target", "env2"]


def test_a_process_speaks_in_the_episode_of_its_environment_and_the_learner_in_the_first_ones(
    told: Stage,
) -> None:
    _, texts = reading.texts(told.path, "/log")
    episodes, _ = reading.texts(told.path, "/log", timeline="episode")
    assert sorted(texts) == ["[agent_service.2] core 1", "[env_server.0] core 1", "[learner] core 1"]
    # Tick 50: of env0 in its sixth episode of 10, of env2 in its third of 20.
    assert episodes.tolist() == [2, 5, 5]
    assert reading.columns(told.path, "/learner/alpha", timeline="episode")[0].tolist() == [5]


def test_the_run_card_and_the_books_are_of_all(told: Stage) -> None:
    card = reading.document(told.path)
    assert "| fleet | 3 of it, env0 to env2, with an agent each |" in card
    assert "| agent_service.2 | core 1 |" in card
    counters = told.ledger.stats(0).counters
    assert (counters["dropped"], counters["gaps.env0"], counters["gaps.env2"]) == (0, 0, 0)
    # Per environment five series, speed, point and frame: 7; and the sparse ones.
    versions = sum(tick_of(f"env{i}", seq).policy_version >= 0 for i in range(3) for seq in range(120))
    returns = 12 + 8 + (6 - 1)  # the late step broke an episode of env2
    assert counters["rows"] > 3 * 7 * 120 + versions + returns


def test_only_a_fleet_has_a_counter_for_each_environment(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    stage.spec.put(SPEC)
    stage.steps([make_step(seq) for seq in range(60)], last=True)
    stage.service.close()
    assert set(stage.ledger.stats(0).counters) == {"rows", "dropped", "disk_dropped", "live_dropped"}
    assert reading.env_roots(stage.path) == [""]


def test_the_place_has_room_for_all(tmp_path: Path) -> None:
    fleet = set_fleet(tmp_path, 3)
    fleet.declare("env0")
    fleet.play(range(60), "env0")
    size = (fleet.stage.run_dir.logs_dir / "recorder.place").stat().st_size
    assert size == 2 * (SLOT_BYTES + 2 * ENV_BYTES)


def test_one_that_never_declares_itself_is_told(tmp_path: Path) -> None:
    fleet = set_fleet(tmp_path)
    fleet.declare("env0")
    fleet.play(range(60), "env0")
    fleet.stage.service.close()
    assert [event.text for event in fleet.stage.events()] == [
        "env1 never declared itself: the recording has nothing of it"
    ]
    assert reading.env_roots(fleet.stage.path) == ["/env0"]


def test_a_gap_is_counted_and_told_where_it_is(tmp_path: Path) -> None:
    fleet = set_fleet(tmp_path)
    stage = fleet.stage
    fleet.declare("env0", "env1")
    fleet.play(range(20), "env0", "env1")
    fleet.play(range(20, 50), "env0")
    fleet.send("env1", [tick_of("env1", seq) for seq in range(25, 50)])
    stage.service.poll()
    stage.clock.advance_ns(6 * UNIT)
    stage.service.poll()
    stage.service.flush()
    assert [event.text for event in stage.events()] == [
        "env1: 5 steps never came: their ticks are missing from the recording"
    ]
    counters = stage.ledger.stats(0).counters
    assert (counters["dropped"], counters["gaps.env0"], counters["gaps.env1"]) == (5, 0, 5)
    stage.service.close()
    assert ticks(stage, "env0") == list(range(50))
    assert ticks(stage, "env1") == [*range(20), *range(25, 50)]


def test_a_chunk_of_one_waits_for_enough_rows_of_the_other(tmp_path: Path) -> None:
    fleet = set_fleet(tmp_path)
    fleet.declare("env0", "env1")
    stage, rows = fleet.stage, []
    for ms in range(0, 1100, 10):  # 100 steps a second of env0, and 60 of env1
        stage.clock.sleep_until_ns(T0 + ms * MS)
        fleet.send("env0", [make_step(ms // 10, due_ns=T0 + ms * MS)])
        begin, end = ms * 6 // 100, (ms + 10) * 6 // 100
        if end > begin:
            fleet.send("env1", [make_step(begin, due_ns=T0 + ms * MS)])
        stage.service.poll()
        rows.append(stage.ledger.counter("rows"))
    # Not after 0.5 s, when env0 has 50 alone, but when env1 has them as well.
    assert [10 * i for i in range(1, 110) if rows[i] != rows[i - 1]] == [830]
    stage.service.close()


def test_a_recorder_that_comes_back_goes_on_with_all_of_them(tmp_path: Path) -> None:
    first = set_fleet(tmp_path)
    first.declare("env0", "env1", "env2")
    first.play(range(55), "env0")
    for env, upto in (("env1", 40), ("env2", 50)):
        first.send(env, [tick_of(env, seq) for seq in range(upto)])
    first.stage.service.poll()
    first.stage.service.flush()  # and then it dies
    first.stage.bus.close()
    second = Fleet(come_back(first.stage))
    second.declare("env1")  # the other is between two lives, and not there before the recorder dies again
    second.send("env1", [tick_of("env1", seq) for seq in range(80)])
    second.stage.service.poll()
    second.stage.service.flush()
    second.stage.bus.close()
    third = Fleet(come_back(second.stage))
    third.declare("env0", "env1")
    third.send("env0", [tick_of("env0", seq) for seq in range(90)], last=True)  # the whole log again
    third.send("env1", [tick_of("env1", seq) for seq in range(100)], last=True)
    third.stage.service.close()
    assert ticks(third.stage, "env0") == list(range(90))
    assert ticks(third.stage, "env1") == list(range(100))
    # Returns are summed across the lives: of env0's episode of ticks 50 to 59 as of env1's from 30 to 44.
    at, returns = reading.columns(third.stage.path, "/env0/env/return")
    assert dict(zip(at.tolist(), returns[:, 0].tolist(), strict=True))[59] == sum(range(51, 60))
    at, returns = reading.columns(third.stage.path, "/env1/env/return")
    assert dict(zip(at.tolist(), returns[:, 0].tolist(), strict=True))[44] == sum(
        100 + k for k in range(31, 45)
    )


@pytest.mark.parametrize(
    ("last", "final", "waited_s"),
    [
        (("env0", "env1"), ("agent_service.0", "agent_service.1"), 0.0),
        (("env0",), ("agent_service.0", "agent_service.1"), 2.0),
        (("env0", "env1"), ("agent_service.0",), 2.0),
    ],
)
def test_the_last_words_of_all_are_waited_for(
    tmp_path: Path, last: tuple[str, ...], final: tuple[str, ...], waited_s: float
) -> None:
    fleet = set_fleet(tmp_path)
    stage = fleet.stage
    fleet.declare("env0", "env1")
    for i in range(2):
        stage.stats(make_stats(f"agent_service.{i}", 0, T0))
        fleet.send(f"env{i}", [tick_of(f"env{i}", seq) for seq in range(10)], last=f"env{i}" in last)
    stage.stats(make_stats("recorder", 0, T0))
    stage.service.poll()
    for process in final:
        stage.stats(make_stats(process, 1, T0, final=True))
    stage.service.poll()
    assert drain(stage) == pytest.approx(waited_s * 1e9, abs=50 * MS)


def test_equal_ticks_have_equal_run_times_and_their_own_wall_times(tmp_path: Path) -> None:
    fleet = set_fleet(tmp_path)
    fleet.declare("env0")
    late = TICK // 2  # the second of two ticks half a tick later
    fleet.declare("env1", t0_ns=T0 + late, wall_t0_ns=SPEC.wall_t0_ns + late)
    fleet.send("env0", [tick_of("env0", seq) for seq in range(20)])
    fleet.send("env1", [make_step(seq, due_ns=T0 + late + seq * TICK) for seq in range(20)])
    fleet.stage.service.poll()
    fleet.stage.service.close()
    expected: dict[reading.TimelineName, int] = {"tick": 0, "run_time": 0, "wall": late}
    for timeline, apart in expected.items():
        of_envs = [
            reading.columns(fleet.stage.path, f"/env{i}/env/reward", timeline=timeline)[0] for i in range(2)
        ]
        assert (of_envs[1] - of_envs[0]).tolist() == [apart] * 20, timeline
