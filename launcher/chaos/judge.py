"""Whether a run kept its promises under faults: each clause with its verdict and its numbers. Pure."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from launcher.chaos.clause import Clause, together
from launcher.chaos.evidence import Evidence
from launcher.chaos.layout import lay_out, masks
from launcher.summary import discrepancies
from rtcore.cast import role_of
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER

# The pacing error beside others' faults may be twice what it is in quiet; a tenth of a period is no matter.
TIMES, OF_PERIOD = 2.0, 0.1
# Deadlines lost beside others' faults, beyond the share in quiet: one in a thousand, and one stall of a tenth
# of a second. On a machine with nine runnable processes on two cores a process with a real-time priority was
# stalled for 30 to 50 ms some three times a minute, faults or not.
LOST_SHARE, STALL_S = 1e-3, 0.1
LEAST_QUIET = 500  # ticks, for a p99 to compare with


def judge(evidence: Evidence) -> list[Clause]:
    """All clauses; of a fleet, what is an environment's own is judged of each."""
    of_run = (carried_out, deaths, report)
    clauses: Sequence[Callable[[Evidence], Clause]] = (
        carried_out, pacing, overruns, transitions, versions, policies, deadlines, deaths, report, recording
    )  # fmt: skip
    return [
        _of_each(clause, evidence) if evidence.fleet and clause not in of_run else clause(evidence)
        for clause in clauses
    ]


def _of_each(clause: Callable[[Evidence], Clause], evidence: Evidence) -> Clause:
    """A clause of every environment; what is lost and missing in all, too."""
    each = {one.env: clause(one) for one in evidence.fleet}
    whole = None
    if clause is transitions:
        whole = transitions(evidence)
    elif clause is recording:
        whole = _dropped(evidence, list(each.values()))
    return together(each, whole)


def carried_out(evidence: Evidence) -> Clause:
    """Every fault that was planned befell a process."""
    done = [one for one in evidence.done if one.at_s is not None]
    counted = Counter(f"{one.fault.process} {one.fault.kind}" for one in done)
    text = f"{len(done)} of {len(evidence.done)} faults"
    return Clause("carried out", len(done) == len(evidence.done), text, dict(sorted(counted.items())))


def pacing(evidence: Evidence) -> Clause:
    """The env server wakes as punctually beside others' faults as in quiet."""
    quiet, beside = masks(evidence)
    found = evidence.recorded.pacing_us
    if not beside.any():
        return Clause("pacing", None, "no tick beside a fault of another process")
    limit_us = OF_PERIOD * evidence.tick_s * 1e6
    p99_us = float(np.percentile(found[beside], 99))
    numbers: dict[str, Any] = {"beside_p99_us": p99_us, "beside_ticks": int(beside.sum())}
    against = "too few quiet ticks to compare with"
    if quiet.sum() >= LEAST_QUIET:
        quiet_us = float(np.percentile(found[quiet], 99))
        limit_us = max(limit_us, TIMES * quiet_us)
        numbers |= {"quiet_p99_us": quiet_us, "quiet_ticks": int(quiet.sum())}
        against = f"{quiet_us:,.0f} in quiet"
    numbers["limit_us"] = limit_us
    text = f"p99 {p99_us:,.0f} µs beside others' faults, {against}; at most {limit_us:,.0f}"
    return Clause("pacing", p99_us <= limit_us, text, numbers)


def overruns(evidence: Evidence) -> Clause:
    """It loses no more deadlines beside others' faults than in quiet."""
    quiet, beside = masks(evidence)
    if not beside.any():
        return Clause("overruns", None, "no tick beside a fault of another process")
    ticks = evidence.recorded.ticks
    spans = lay_out(evidence.lives.get(ENV_SERVER, ()), ticks)
    absent = sum(max(0, span.head + span.holes - span.life.counters.get("skipped", 0)) for span in spans)
    if absent:  # who lost which cannot be told apart
        return Clause("overruns", None, f"{absent:,} ticks are not in the recording")
    gaps = np.diff(ticks, prepend=ticks[:1] - 1) - 1
    lost, quiet_lost = (int(gaps[mask].clip(0).sum()) for mask in (beside, quiet))
    all_beside, all_quiet = lost + int(beside.sum()), quiet_lost + int(quiet.sum())
    quiet_share = quiet_lost / all_quiet if all_quiet else 0.0
    limit = (quiet_share + LOST_SHARE) * all_beside + STALL_S / evidence.tick_s
    text = f"{lost} of {all_beside:,} deadlines lost beside others' faults, {quiet_lost} of {all_quiet:,} in "
    text += f"quiet; at most {limit:,.0f}"
    numbers = {
        "beside_lost": lost, "beside": all_beside, "quiet_lost": quiet_lost, "quiet": all_quiet,
        "limit": limit,
    }  # fmt: skip
    return Clause("overruns", lost <= limit, text, numbers)


def transitions(evidence: Evidence) -> Clause:
    """What is lost was lost with an env server that died, and the loss is exact."""
    produced = evidence.total(ENV_SERVER, "produced")
    learned = evidence.total(LEARNER, "learned") - evidence.total(LEARNER, "unread")
    gaps, lost = evidence.total(LEARNER, "gaps"), produced - learned
    died = sum(not life.ended for life in evidence.of_role(ENV_SERVER))  # or still lives
    uncertain = evidence.total(LEARNER, "unread") or evidence.total(LEARNER, "replay.unbacked")
    kept = None if uncertain else evidence.kept
    problems = []
    if lost < 0:
        problems.append("more learned than produced")
    if lost and not died:
        problems.append("lost without a death")
    if gaps:
        problems.append(f"{gaps} steps missing in the midst of a life")
    if kept is not None and evidence.ended and kept != learned:
        problems.append(f"the replay was given {kept:,}")
    text = (
        f"{produced:,} produced, {learned:,} learned, {lost:,} lost; {died} env servers did not end in order"
    )
    numbers = {"produced": produced, "learned": learned, "lost": lost, "gaps": gaps, "kept": kept}
    return Clause("transitions", not problems, "; ".join([text, *problems]), numbers)


def versions(evidence: Evidence) -> Clause:
    """Policy versions rise from one publication to the next, and never fall from one tick to the next."""
    published, acted = evidence.recorded.published, evidence.recorded.acted
    random_ticks = int((acted == 0).sum())
    acted = acted[acted > 0]
    repeated = int((np.diff(published) <= 0).sum())
    fallen = int((np.diff(acted) < 0).sum())
    last = evidence.total(LEARNER, "published")
    text = f"{len(published)} publications recorded, up to version {published.max(initial=0)}; "
    text += f"{len(np.unique(acted))} acted, pi_0 in {random_ticks:,} ticks"
    if repeated or fallen:
        text += f"; {repeated} publications and {fallen} ticks do not rise"
    numbers = {"recorded": len(published), "published": last, "not_rising": repeated, "fallen": fallen}
    return Clause("versions", repeated == 0 and fallen == 0, text, numbers | {"random_ticks": random_ticks})


def policies(evidence: Evidence) -> Clause:
    """Whatever acted had passed the agent's checks."""
    acted = set(evidence.recorded.acted.tolist()) - {0}
    newest = max(
        (life.counters.get("last_version", 0) for life in evidence.lives.get(LEARNER, ())), default=0
    )
    bad, unknown = sorted(acted & evidence.refused), sorted(one for one in acted if one > newest)
    adopted, rejected, foreign = (
        evidence.total(AGENT, f"policies.{fate}") for fate in ("adopted", "rejected", "foreign")
    )
    text = f"{adopted} adopted, {rejected} refused, {foreign} foreign"
    if bad or unknown:
        text += f"; acted though refused: {bad or 'none'}, though never published: {unknown or 'none'}"
    numbers = {
        "adopted": adopted, "rejected": rejected, "foreign": foreign, "refused_acted": bad,
        "unknown_acted": unknown,
    }  # fmt: skip
    return Clause("policies", not bad and not unknown, text, numbers)


def deadlines(evidence: Evidence) -> Clause:
    """Every deadline of the run was ticked, skipped by an overrun, or passed while no env server lived."""
    ticks, skipped, down = (evidence.total(ENV_SERVER, name) for name in ("ticks", "skipped", "down"))
    numbers = {"ticks": ticks, "skipped": skipped, "down": down, "deadlines": evidence.num_ticks}
    text = f"{ticks:,} ticks + {skipped:,} skipped + {down:,} down = {ticks + skipped + down:,}"
    whole = evidence.num_ticks is not None and (evidence.summary or {}).get("ended") == "duration"
    reset = evidence.total(ENV_SERVER, "resets") + evidence.total(ENV_SERVER, "produced")
    if reset != ticks:
        return Clause("deadlines", False, f"{text}; but {reset:,} produced or reset", numbers)
    if not whole:
        return Clause("deadlines", None, f"{text}; the run did not go on to its end", numbers)
    return Clause(
        "deadlines",
        ticks + skipped + down == evidence.num_ticks,
        f"{text} of {evidence.num_ticks:,}",
        numbers,
    )


def deaths(evidence: Evidence) -> Clause:
    """Nobody died but by our hand, and whoever did was started again."""
    if evidence.summary is None:
        return Clause("deaths", None, "no summary")
    told = evidence.summary["supervision"]
    ours = Counter(
        one.fault.process for one in evidence.done if one.at_s is not None and one.fault.kind == "kill"
    )
    died = Counter(one["process"] for one in told if one["what"] in ("died", "stuck"))
    again = evidence.summary["restarts"]
    others = {name: died[name] - ours[name] for name in (ours | died) if died[name] != ours[name]}
    odd = [
        f"{one['process']} {one['what']} at {one['at_s']:.1f} s (code {one['code']})"
        for one in told
        if one["what"] in ("stuck", "gave_up") or one["code"] not in (None, -signal.SIGKILL)
    ]
    text = f"{ours.total()} by our hand, {died.total()} in all, {sum(again.values())} restarts"
    if others:
        text += "; " + ", ".join(f"{name} {n:+d}" for name, n in others.items())
    killed = Counter(role_of(name) for name in ours.elements())  # the summary counts restarts by role
    holds = not others and not odd and all(again.get(role, 0) == killed[role] for role in PROCESSES)
    return Clause("deaths", holds, "; ".join([text, *odd]), {"ours": dict(ours), "died": dict(died)})


def report(evidence: Evidence) -> Clause:
    """There is a summary, and its counts reconcile."""
    if evidence.summary is None:
        return Clause("report", False if evidence.ended else None, "no summary.json")
    found = discrepancies(evidence.summary)
    if evidence.summary["forced"]:
        found.append(f"{', '.join(evidence.summary['forced'])} had to be killed at the end")
    text = f"ended: {evidence.summary['ended']}; " + ("; ".join(found) if found else "its counts reconcile")
    return Clause("report", not found, text, {"discrepancies": found})


def recording(evidence: Evidence) -> Clause:
    """Every tick is in the recording once, but for those counted as dropped, or dead with an env server."""
    if evidence.recorded.problem:
        return Clause("recording", False, evidence.recorded.problem)
    dropped = evidence.total(RECORDER, "dropped")
    rows = evidence.recorded.ticks
    unique = np.unique(rows)
    spans = lay_out(evidence.lives.get(ENV_SERVER, ()), unique)
    stray = len(unique) - sum(span.rows for span in spans)
    missing = died = 0
    for i, span in enumerate(spans):
        absent = span.life.counters.get("ticks", 0) - span.rows
        last = i + 1 == len(spans)
        if span.life.ended or (last and evidence.ended):
            missing += absent
        else:  # it died: its last ticks may have died with it
            inside = max(0, span.head + span.holes - span.life.counters.get("skipped", 0)) if span.rows else 0
            missing += inside
            died += 0 if last else absent - inside
    twice = len(rows) - len(unique)
    ticks = evidence.total(ENV_SERVER, "ticks")
    text = f"{len(unique):,} of {ticks:,} ticks; {died:,} died with env servers, {missing:,} missing, "
    text += f"{dropped:,} counted as dropped"
    text += f"; {twice:,} twice" * bool(twice) + f"; {stray:,} of no life" * bool(stray)
    numbers = {"rows": len(rows), "ticks": ticks, "died": died, "missing": missing, "dropped": dropped}
    holds = missing <= dropped and not twice and not stray and len(unique) > 0
    return Clause("recording", holds, text, numbers | {"twice": twice, "stray": stray})


def _dropped(evidence: Evidence, each: Sequence[Clause]) -> Clause:
    """The recorder's count of what it dropped is one, so it is held against what all environments lack."""
    names = ("rows", "ticks", "died", "missing")
    numbers = {name: sum(one.numbers.get(name, 0) for one in each) for name in names}
    dropped = numbers["dropped"] = evidence.total(RECORDER, "dropped")
    text = f"{numbers['rows']:,} of {numbers['ticks']:,} ticks; {numbers['died']:,} died with env servers, "
    text += f"{numbers['missing']:,} missing, {dropped:,} counted as dropped"
    return Clause("recording", numbers["missing"] <= dropped, text, numbers)
