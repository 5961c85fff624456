"""Chaos in a fleet: everything is judged of each environment, by hand."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from env_server.worlds.registry import resolve
from launcher import presets
from launcher.chaos.clause import Clause, passed, together
from launcher.chaos.evidence import Evidence, Life, Recorded, gather
from launcher.chaos.faults import Done, Lives
from launcher.chaos.judge import judge
from launcher.chaos.layout import masks
from launcher.chaos.plan import FILLED, Fault, plan
from launcher.chaos.report import render
from launcher.sim import simulate
from rtcore import cast
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.config import EnvConfig, RunConfig
from rtcore.lifecycle import Stop
from rtcore.run_dir import RunDir
from tests.launcher import chaos_runs
from tests.launcher.chaos_runs import FIRST, SECOND, TICKS, recorded, verdict

FLEET = RunConfig(env=EnvConfig(count=2))
QUIET = {"lives": 1, "ticks": 4000, "resets": 40, "produced": 3960, "skipped": 0, "down": 0}
WHOLE = np.arange(4000)
# The first environment has the run of `chaos_runs`: its env server dies at 30 s, and 2 transitions with it.
# The second one's agent is stopped at 20 s. The learner dies at 10 s.
FAULTS = (
    Fault(10.0, LEARNER, "kill"),
    Fault(20.0, "agent_service.1", "stop", 2.0),
    Fault(30.0, "env_server.0", "kill"),
)
LEARNERS = (
    {"learned": 2000, "learned.env0": 1000, "learned.env1": 1000, "last_version": 4, "published": 4},
    {"learned": 5865, "learned.env0": 2905, "learned.env1": 2960, "last_version": 9},
)


def summary(**changes: Any) -> dict[str, Any]:
    told = [
        {"at_s": 10.0, "process": LEARNER, "what": "died", "code": -9},
        {"at_s": 10.1, "process": LEARNER, "what": "restarted", "code": None},
        {"at_s": 30.0, "process": "env_server.0", "what": "died", "code": -9},
        {"at_s": 30.1, "process": "env_server.0", "what": "restarted", "code": None},
    ]
    return {
        "ended": "duration", "forced": [], "supervision": told,
        "restarts": dict.fromkeys(PROCESSES, 0) | {LEARNER: 1, ENV_SERVER: 1},
    } | changes  # fmt: skip


def evidence(
    *,
    servers: Mapping[str, list[Life]] | None = None,
    learner: tuple[Mapping[str, int], ...] = LEARNERS,
    rows: Mapping[str, Recorded] | None = None,
    refused: Mapping[str, frozenset[int]] | None = None,
    dropped: int = 0,
    **changes: Any,
) -> Evidence:
    """A fleet of two that kept every promise; the learner's life before the last was killed."""
    lives = {
        "env_server.0": [Life(FIRST, False), Life(SECOND, True)],
        "env_server.1": [Life(QUIET, True)],
        "agent_service.0": [Life({"policies.adopted": 10}, True)],
        "agent_service.1": [Life({"policies.adopted": 9}, True)],
        LEARNER: [Life(counters, i == len(learner) - 1) for i, counters in enumerate(learner)],
        RECORDER: [Life({"dropped": dropped}, True)],
    } | dict(servers or {})
    settings: dict[str, Any] = {
        "done": [Done(fault, fault.at_s) for fault in FAULTS],
        "ended": True,
        "tick_s": 0.01,
        "num_ticks": 4000,
        "summary": summary(),
        "lives": lives,
        "recorded": Recorded(published=np.arange(1, 10)),
        "kept": 7865,
    }
    whole = Evidence(**(settings | changes))
    told = {"env0": recorded(), "env1": recorded(WHOLE)} | dict(rows or {})
    refusals = dict.fromkeys(told, frozenset[int]()) | dict(refused or {})
    envs = [whole.of(i, env, one, refusals[env]) for i, (env, one) in enumerate(told.items())]
    return replace(whole, fleet=tuple(envs))


@pytest.fixture(autouse=True)
def reconciled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The made-up summary has no more of a summary than is read here."""
    monkeypatch.setattr("launcher.chaos.judge.discrepancies", lambda summary: summary.get("odd", []))


def test_a_fleet_that_kept_everything() -> None:
    clauses = judge(evidence())
    assert [clause.name for clause in clauses] == [
        "carried out", "pacing", "overruns", "transitions", "versions", "policies", "deadlines", "deaths",
        "report", "recording",
    ]  # fmt: skip
    assert {clause.name: clause.holds for clause in clauses} == {clause.name: True for clause in clauses}
    assert passed(clauses)


def test_an_environments_evidence_is_that_of_a_run_of_its_own() -> None:
    """The first environment's agent was stopped in `chaos_runs`; here it was the other one's."""
    alone = chaos_runs.evidence()
    mine = evidence().fleet[0]
    assert mine.lives[ENV_SERVER] == alone.lives[ENV_SERVER]
    assert [life.counters["learned"] for life in mine.lives[LEARNER]] == [1000, 2905]
    assert [life.counters["last_version"] for life in mine.lives[LEARNER]] == [4, 9]
    assert mine.total(AGENT, "policies.adopted") == 10
    assert [one.fault.process for one in mine.done] == [LEARNER, "agent_service.1", ENV_SERVER]
    for own, other in zip(masks(mine), masks(alone), strict=True):
        assert (own == other).all()  # another's agent disturbs as its own does


def test_anothers_env_server_is_another_process() -> None:
    quiet, beside = masks(evidence().fleet[1])
    # the learner's kill: 10 to 15 s; its own agent's stop: 20 to 23 s; the other's env server: 30 to 35 s
    assert [bool(beside[tick]) for tick in (999, 1000, 1500, 2300, 2301, 2999, 3000, 3500, 3501)] == [
        False, True, True, True, False, False, True, True, False,
    ]  # fmt: skip
    assert not quiet[:51].any()  # its life begins
    assert quiet[2990]


def test_what_is_lost_is_lost_with_its_own_env_server() -> None:
    found = verdict("transitions", evidence())
    assert (found.numbers["lost"], found.numbers["produced"]) == (2, 7867)
    assert {env: one["lost"] for env, one in found.numbers["envs"].items()} == {"env0": 2, "env1": 0}
    # the other one's env server did not die; the totals alone would not tell
    moved = tuple(one | {"learned.env0": one["learned.env0"] + i, "learned.env1": one["learned.env1"] - i}
                  for one, i in zip(LEARNERS, (1, 0), strict=True))  # fmt: skip
    broken = verdict("transitions", evidence(learner=moved))
    assert broken.holds is False
    assert broken.text.startswith("1 of 2 environments broke it; env1: ")
    assert broken.text.endswith("lost without a death")
    gaps = (LEARNERS[0], LEARNERS[1] | {"gaps": 2, "gaps.env1": 2})
    assert "2 steps missing" in verdict("transitions", evidence(learner=gaps)).text


def test_the_replay_is_held_against_the_sum() -> None:
    assert verdict("transitions", evidence(kept=7864)).text.endswith("the replay was given 7,864")
    assert verdict("transitions", evidence(kept=7864)).holds is False


def test_deadlines_are_each_environments_own() -> None:
    short = {"env_server.1": [Life(QUIET | {"ticks": 3999, "resets": 39}, True)]}
    found = verdict("deadlines", evidence(servers=short))
    assert found.holds is False
    assert found.text.startswith("1 of 2 environments broke it; env1: 3,999 ticks")
    assert found.numbers["envs"]["env0"]["deadlines"] == 4000


@pytest.mark.parametrize("env", ["env0", "env1"])
def test_late_beside_a_fault_is_told_of_who_was(env: str) -> None:
    one = next(one for one in evidence().fleet if one.env == env)
    _, beside = masks(one)
    ticks = one.recorded.ticks
    late = recorded(ticks, pacing_us=np.where(beside, 1500.0, 50.0))
    found = verdict("pacing", evidence(rows={env: late}))
    assert found.holds is False
    assert f"; {env}: p99 1,500" in found.text


def test_versions_and_policies_are_the_agents_own() -> None:
    back = recorded(WHOLE, acted=np.array([1, 2, 3, 2]))
    assert "env1: " in verdict("versions", evidence(rows={"env1": back})).text
    assert verdict("versions", evidence(rows={"env1": back})).holds is False
    refused = {"env1": frozenset({5})}
    assert verdict("policies", evidence(refused=refused)).holds is False
    assert verdict("policies", evidence(refused={"env1": frozenset({4})})).holds
    twice = recorded(published=np.array([1, 2, 2]))
    assert verdict("versions", evidence(rows={"env0": twice})).holds is False


def test_deaths_are_by_name_and_restarts_by_role() -> None:
    assert verdict("deaths", evidence()).numbers["ours"] == {LEARNER: 1, "env_server.0": 1}
    told = summary()["supervision"]
    other = [one | {"process": "env_server.1"} if one["process"] == "env_server.0" else one for one in told]
    found = verdict("deaths", evidence(summary=summary(supervision=other)))
    assert found.holds is False
    assert "env_server.0 -1" in found.text
    assert "env_server.1 +1" in found.text
    once = summary(restarts=dict.fromkeys(PROCESSES, 0) | {LEARNER: 1})
    assert verdict("deaths", evidence(summary=once)).holds is False


def test_the_recording_has_every_tick_of_every_environment() -> None:
    whole = verdict("recording", evidence())
    assert (whole.numbers["missing"], whole.numbers["died"], whole.numbers["rows"]) == (0, 2, 7945)
    absent = {"env0": recorded(TICKS[TICKS != 700]), "env1": recorded(WHOLE[WHOLE != 900])}
    assert verdict("recording", evidence(rows=absent, dropped=2)).holds
    # each environment alone lacks no more than was dropped; both together do
    one = verdict("recording", evidence(rows=absent, dropped=1))
    assert (one.holds, one.numbers["missing"]) == (False, 2)
    twice = {"env1": recorded(np.sort(np.append(WHOLE, 7)))}
    assert "env1: " in verdict("recording", evidence(rows=twice)).text
    gone = {"env1": Recorded(problem="torn")}
    assert verdict("recording", evidence(rows=gone)).holds is False


def test_a_verdict_is_as_bad_as_the_worst() -> None:
    kept, unknown, broken = (Clause("x", holds, str(holds), {"n": 1}) for holds in (True, None, False))
    assert together({"a": kept, "b": kept}) == Clause(
        "x", True, "2 of 2 environments kept it; a: True", {"envs": {"a": {"n": 1}, "b": {"n": 1}}}
    )
    assert together({"a": kept, "b": unknown}).text == "1 of 2 environments not judged; b: None"
    assert together({"a": unknown, "b": broken, "c": broken}).text == "2 of 3 environments broke it; b: False"
    assert together({"a": kept}, replace(broken, text="sum")).text == "sum"
    assert together({"a": kept}, replace(kept, text="sum")).text == "sum"
    assert together({"a": broken}, replace(kept, text="sum")).holds is False


def test_faults_are_dealt_to_all_by_name() -> None:
    names = cast.names(FLEET)
    faults = plan(3, 60, 600.0, ("kill", "stop"), names)
    assert Counter(fault.process for fault in faults) == dict.fromkeys(names, 10)
    filled = plan(3, 12, 600.0, ("fill",), names)
    assert {fault.process for fault in filled} == set(FILLED)
    assert plan(3, 60, 600.0, ("kill",), PROCESSES) == plan(3, 60, 600.0, ("kill",))


def test_a_process_is_found_by_its_index(tmp_path: Path) -> None:
    (tmp_path / "env_server.py").write_text("import time\nprint(flush=True)\ntime.sleep(60)\n")
    run = tmp_path / "run"
    children = []
    try:
        for index in (1, 12):
            command = [sys.executable, "-m", "env_server", "--run", str(run), "--index", str(index)]
            child = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE)
            children.append(child)
            assert child.stdout is not None
            child.stdout.readline()
        lives = Lives(run)
        found = [
            lives.pids(name) for name in ("env_server.1", "env_server.12", "env_server.2", "agent_service.1")
        ]
        assert found == [[children[0].pid], [children[1].pid], [], []]
    finally:
        for child in children:
            child.kill()
            child.communicate()


def test_the_screen_counts_faults_by_role(tmp_path: Path) -> None:
    done = [Done(Fault(float(i), f"env_server.{i % 2}", "kill"), float(i)) for i in range(5)]
    with (tmp_path / "screen").open("w") as file:
        Console(width=100, file=file).print(render("run", done, judge(evidence()), tmp_path))
    lines = (tmp_path / "screen").read_text().splitlines()
    assert len(lines) <= 40
    assert any(line.split()[1:3] == ["env_server", "5"] for line in lines), lines


def test_the_evidence_of_a_fleet_is_read_by_environment(tmp_path: Path) -> None:
    """Two for three seconds at 40 Hz, in virtual time; the second one's agent refused a policy."""
    preset = presets.load("pointmass")
    config = replace(
        preset,
        duration_s=3.0,
        env=resolve(replace(preset.env, hz=40.0, speed=None, count=2)),
        learner=replace(preset.learner, hidden=(8,), batch=8, learning_starts=20, utd=0.1),
        recorder=replace(preset.recorder, detail="light"),
    )
    run_dir = RunDir.create(tmp_path / "run", config)
    stats, _ = simulate(config, run_dir, Stop(), lambda _: None)
    for (last,) in stats.values():
        run_dir.write_final_stats(last)
    run_dir.log_path("agent_service.1").write_text('{"text": "policy 9 refused: not finite"}\n')
    found = gather(run_dir, [], ended=True)
    assert (found.recorded.problem, list(found.recorded.ticks)) == ("", [])
    assert [one.env for one in found.fleet] == ["env0", "env1"]
    assert [one.refused for one in found.fleet] == [frozenset(), frozenset({9})]
    for one in found.fleet:
        assert one.recorded.ticks.tolist() == list(range(120))
        assert (len(one.recorded.pacing_us), len(one.recorded.acted)) == (120, 118)  # not at a reset
        assert one.recorded.published.tolist() == found.recorded.published.tolist() != []
        assert (one.total(ENV_SERVER, "ticks"), one.total(LEARNER, "learned")) == (120, 118)
    clauses = {clause.name: clause.holds for clause in judge(found)}
    assert [clauses[name] for name in ("transitions", "versions", "policies", "recording")] == [True] * 4
    assert verdict("transitions", found).numbers["kept"] == 236
