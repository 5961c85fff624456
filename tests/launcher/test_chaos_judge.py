"""Each clause of the verdict on runs made up by hand: one that keeps it, and ones that break it."""

from __future__ import annotations

import dataclasses
import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from agent_service.adoption import COMPLAINT_NS, Adoption, Past
from launcher import keys
from launcher.chaos.clause import Clause, passed
from launcher.chaos.evidence import Evidence, Life, Recorded, gather, refused
from launcher.chaos.faults import Done
from launcher.chaos.judge import judge
from launcher.chaos.layout import lay_out, masks
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES
from rtcore.config import EnvConfig, LinkConfig, RunConfig
from rtcore.ledger import Ledger
from rtcore.run_dir import RunDir
from rtcore.signing import open_signer, open_verifier
from tests.agent_service.rig import SPEC, policy
from tests.launcher.chaos_runs import (
    FIRST,
    KILLED,
    LEARNERS,
    SECOND,
    STOPPED,
    TICKS,
    evidence,
    recorded,
    summary,
    verdict,
)


def test_a_run_that_kept_everything() -> None:
    clauses = judge(evidence())
    assert {clause.name: clause.holds for clause in clauses} == dict.fromkeys(
        ("carried out", "pacing", "overruns", "transitions", "versions", "policies", "deadlines", "deaths",
         "report", "recording"), True
    )  # fmt: skip
    assert passed(clauses)


def test_a_run_of_which_nothing_is_left_breaks_promises_and_no_code() -> None:
    nothing = Evidence(
        done=[], ended=True, tick_s=0.01, num_ticks=None, summary=None, lives={},
        recorded=Recorded(problem="no such file"),
    )  # fmt: skip
    broken = [clause.name for clause in judge(nothing) if clause.holds is False]
    assert broken == ["report", "recording"]


def test_lives_tile_the_deadlines() -> None:
    lives = evidence().lives[ENV_SERVER]
    first, second = lay_out([Life({"lives": 0, "ticks": 0}, False), *lives], TICKS)
    # 2997 ticks and 3 skipped: [0, 3000); 50 down; 950 ticks: [3050, 4000)
    assert (first.first, first.end, first.rows, first.head, first.holes) == (0, 3000, 2995, 0, 3)
    assert (second.first, second.end, second.rows, second.head, second.holes) == (3050, 4000, 950, 0, 0)


def test_quiet_ticks_and_those_beside_others_faults() -> None:
    quiet, beside = masks(evidence())
    at = {tick: i for i, tick in enumerate(TICKS.tolist())}
    # the kill of the learner: 10 s to 15 s; the stop of the agent: 20 s to 22 s, and a second
    assert [bool(beside[at[tick]]) for tick in (999, 1000, 1500, 1501, 1999, 2000, 2300, 2301)] == [
        False, True, True, False, False, True, True, False,
    ]  # fmt: skip
    assert beside.sum() == 501 + 301
    # the env server's own: its lives begin at 0 s and 30.5 s, and it dies at 30 s, each with half a second
    assert not (quiet & beside).any()
    own = ~quiet & ~beside
    assert [bool(own[at[tick]]) for tick in (0, 50, 51, 2949, 2950, 2997, 3050, 3100, 3101)] == [
        True, True, False, False, True, True, True, True, False,
    ]  # fmt: skip


@pytest.mark.parametrize(("late_us", "holds"), [(1000.0, True), (1001.0, False)])
def test_pacing_may_be_late_by_a_tenth_of_a_period_beside_faults(late_us: float, holds: bool) -> None:
    found = evidence()
    _, beside = masks(found)
    pacing_us = np.where(beside, late_us, 50.0)
    late = evidence(recorded=recorded(pacing_us=pacing_us))
    assert verdict("pacing", late).holds is holds
    # it is the same the whole run through: then faults have not made it so
    assert verdict("pacing", evidence(recorded=recorded(pacing_us=np.full(len(TICKS), late_us)))).holds


def test_pacing_is_not_judged_by_the_env_servers_own_faults() -> None:
    quiet, beside = masks(evidence())
    pacing_us = np.where(~quiet & ~beside, 1e6, 50.0)
    assert verdict("pacing", evidence(recorded=recorded(pacing_us=pacing_us))).holds


def test_overruns_beside_faults_are_counted_against_those_in_quiet() -> None:
    def lost(begin: int, count: int) -> Clause:
        """As many deadlines, besides the three that were lost in quiet."""
        ticks = TICKS[~np.isin(TICKS, np.arange(begin, begin + count))]
        first = FIRST | {"ticks": FIRST["ticks"] - count, "skipped": 3 + count}
        return verdict("overruns", evidence(env=(first, SECOND), recorded=recorded(ticks)))

    # 802 rows beside: a share of 1/1000 is 0.8, one stall of 0.1 s is 10 ticks, and quiet lost 3 of some 2940
    assert lost(1100, 10).holds
    assert lost(1100, 10).numbers["beside_lost"] == 10
    assert lost(1100, 13).holds is False
    assert lost(2960, 30).holds  # its own


def test_overruns_are_not_judged_by_a_recording_that_lacks_ticks() -> None:
    absent = TICKS[~np.isin(TICKS, np.arange(1100, 1110))]
    clause = verdict("overruns", evidence(recorded=recorded(absent)))
    assert (clause.holds, clause.text) == (None, "10 ticks are not in the recording")


def test_transitions_may_be_lost_with_an_env_server_alone() -> None:
    assert verdict("transitions", evidence()).numbers["lost"] == 2
    lived = evidence(env=[FIRST | {"lives": 1, "ticks": 3947, "produced": 3907, "resets": 40, "skipped": 53}])
    assert "without a death" in verdict("transitions", lived).text
    assert verdict("transitions", lived).holds is False
    inside = evidence(learner=(LEARNERS[0], LEARNERS[1] | {"gaps": 2}))
    assert "2 steps missing in the midst of a life" in verdict("transitions", inside).text
    twice = evidence(learner=(LEARNERS[0], {"learned": 2908}), kept=3908)
    assert "more learned than produced" in verdict("transitions", twice).text


def test_the_learners_count_is_held_against_its_replay() -> None:
    assert verdict("transitions", evidence(kept=3904)).holds is False
    assert verdict("transitions", evidence(kept=None)).holds  # nobody can tell
    unbacked = (LEARNERS[0], LEARNERS[1] | {"replay.unbacked": 7})
    assert verdict("transitions", evidence(learner=unbacked, kept=3904)).holds  # some are in memory


def test_versions_rise() -> None:
    assert verdict("versions", evidence()).numbers["random_ticks"] == 50
    twice = recorded(published=np.array([1, 2, 3, 3, 4]))
    assert verdict("versions", evidence(recorded=twice)).holds is False
    back = recorded(acted=np.array([1, 2, 0, 2, 3, 2]))
    assert verdict("versions", evidence(recorded=back)).numbers["fallen"] == 1
    assert verdict("versions", evidence(recorded=recorded(acted=np.array([1, 2, 0, 2, 3])))).holds


def test_what_acts_was_checked() -> None:
    assert verdict("policies", evidence(refused=frozenset({4}))).holds
    assert verdict("policies", evidence(refused=frozenset({5}))).holds is False
    assert verdict("policies", evidence(recorded=recorded(acted=np.array([9, 10])))).holds is False
    lives = {**evidence().lives, AGENT: [Life({"policies.adopted": 10, "policies.foreign": 3}, True)]}
    found = verdict("policies", evidence(lives=lives))
    assert (found.holds, found.text, found.numbers["foreign"]) == (
        True, "10 adopted, 0 refused, 3 foreign", 3,
    )  # fmt: skip


def test_a_version_is_refused_for_what_is_in_it(tmp_path: Path) -> None:
    """The words are the agent's own. Version 3 acted before version 4 came; what came as 5, 6 and 7 was
    forged or torn, and the learner's own may act yet; 8 is the learner's, and no policy."""
    keys.make(tmp_path / "keys", now=datetime.now(UTC))
    link = LinkConfig(secure=str(tmp_path / "keys"))
    signer, verifier = open_signer(link, LEARNER, "run"), open_verifier(link, AGENT, "run")
    signed = {version: signer.sign(policy(version, mean_bias=0.1)) for version in range(3, 8)}
    broken = signer.sign(policy(8, mean_bias=float("nan")))
    ledger, log = Ledger(AGENT, 1), tmp_path / "log.jsonl"
    adoption = Adoption(SPEC, ledger, verifier, Past(floor=4))
    for at_s, one in enumerate(
        (
            signed[4],
            signed[3],
            replace(signed[5], signature=b""),
            replace(signed[6], window=2),
            replace(signed[7], weights=b"others"),
            broken,
        ),
        start=1,
    ):
        adoption.offer(one, at_s * COMPLAINT_NS)
    told = [event.text for event in ledger.stats(0).events]
    assert len(told) == 5
    log.write_text("".join(json.dumps({"text": text}) + "\n" for text in told))
    assert refused(log) == {8}


def test_the_duration_is_counted_as_the_env_server_counts_it(tmp_path: Path) -> None:
    """7200 s at 600 Hz: a period of 1 666 667 ns fits 4 319 999 times."""
    config = RunConfig(duration_s=7200.0, env=EnvConfig(id="pointmass", hz=600.0))
    found = gather(RunDir.create(tmp_path / "run", config), [], ended=False)
    assert found.num_ticks == 4_319_999
    config = dataclasses.replace(config, duration_s=0.0)
    assert gather(RunDir.create(tmp_path / "endless", config), [], ended=False).num_ticks is None


def test_deadlines_add_up() -> None:
    assert verdict("deadlines", evidence(env=(FIRST, SECOND | {"down": 49}))).holds is False
    assert verdict("deadlines", evidence(env=(FIRST, SECOND | {"produced": 939}))).holds is False
    assert verdict("deadlines", evidence(summary=summary(ended="interrupted"))).holds is None


def test_nobody_dies_by_itself() -> None:
    told = summary()["supervision"]
    crashed = [*told, {"at_s": 12.0, "process": AGENT, "what": "died", "code": 1}]
    clause = verdict("deaths", evidence(summary=summary(supervision=crashed)))
    assert clause.holds is False
    assert "agent_service +1" in clause.text
    stuck = [{**one, "what": "stuck"} if one["process"] == LEARNER and one["code"] else one for one in told]
    assert verdict("deaths", evidence(summary=summary(supervision=stuck))).holds is False
    never_back = summary(restarts=dict.fromkeys(PROCESSES, 0) | {LEARNER: 1})
    assert verdict("deaths", evidence(summary=never_back)).holds is False


def test_the_report_reconciles() -> None:
    assert verdict("report", evidence(summary=None)).holds is False
    assert verdict("report", evidence(summary=None, ended=False)).holds is None
    assert verdict("report", evidence(summary=summary(ticks=3946))).holds is False
    assert verdict("report", evidence(summary=summary(forced=[LEARNER]))).holds is False


def test_the_recording_has_every_tick_once() -> None:
    whole = verdict("recording", evidence())
    assert (whole.numbers["died"], whole.numbers["missing"]) == (2, 0)
    inside = TICKS[TICKS != 700]  # in the midst of a life that was killed later
    assert verdict("recording", evidence(recorded=recorded(inside))).holds is False
    assert verdict("recording", evidence(recorded=recorded(inside), recorder={"dropped": 1})).holds
    end = TICKS[:-5]  # of a life that ended in order
    assert verdict("recording", evidence(recorded=recorded(end))).numbers["missing"] == 5
    assert verdict("recording", evidence(recorded=recorded(end), ended=False)).numbers["missing"] == 5
    twice = np.sort(np.append(TICKS, 700))
    assert verdict("recording", evidence(recorded=recorded(twice))).holds is False
    stray = np.sort(np.append(TICKS, 3020))  # while no env server lived
    assert verdict("recording", evidence(recorded=recorded(stray))).holds is False


def test_what_goes_on_still_has_rows_on_their_way() -> None:
    running = evidence(ended=False, summary=None, recorded=recorded(TICKS[:-5]))
    last = running.lives[ENV_SERVER]
    lives = {**running.lives, ENV_SERVER: [last[0], Life(last[1].counters, False)]}
    clause = verdict("recording", dataclasses.replace(running, lives=lives))
    assert (clause.holds, clause.numbers["missing"], clause.numbers["died"]) == (True, 0, 2)
    assert passed(judge(dataclasses.replace(running, lives=lives)))


def test_a_fault_that_found_nobody_is_told() -> None:
    done = [Done(KILLED, 10.0), Done(STOPPED, None)]
    assert verdict("carried out", evidence(done=done)).text == "1 of 2 faults"
    assert verdict("carried out", evidence(done=done)).holds is False
