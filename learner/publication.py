"""What the others are told: the iterates, numbered, stamped and hashed, and the phases."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

from learner.algorithm import Algorithm
from learner.conductor import PhaseEntered, PublishDue
from learner.outbox import Outbox
from rtcore.clock import Clock
from rtcore.ledger import Ledger
from rtcore.messages import Phase, Policy, Spec, WindowNotice
from rtcore.weights import pack, sha256


class Publication:
    """Announces phases, and publishes iterates, never in a hold.

    Counts `published`, `withheld` (an iterate whose time was over before it was ready), and, from the
    phases as they were announced, `published_in_hold`, which must stay 0. An unchanged policy is not
    published again.
    """

    def __init__(self, algo: str, outbox: Outbox, ledger: Ledger) -> None:
        self._algo = algo
        self._notices: list[WindowNotice] = []  # the phases as announced
        self._outbox = outbox
        self._ledger = ledger
        self._version = 0
        self._created_ns: list[int] = []
        self.improved = False  # since the last one

    def go_on_from(self, version: int) -> None:
        """Number the next policy after `version`, the last one of an earlier learner of this run."""
        self._version = version

    def publish(self, algorithm: Algorithm, due: PublishDue, spec: Spec, clock: Clock) -> None:
        """Publish the policy as it is, unless nothing has changed or its unit is over meanwhile."""
        if not self.improved:
            return
        weights = pack(algorithm.policy_arrays())
        digest = sha256(weights)
        created_ns = clock.now_ns()
        if created_ns - spec.t0_ns > (due.window.start + due.iterate) * spec.unit_ns:
            self.withhold(due.window.m, due.iterate, created_ns)
            return
        self._version += 1
        self.improved = False
        self._ledger.count("published")
        self._created_ns.append(created_ns)
        self._ledger.set_counter("last_version", self._version)
        policy = Policy(
            version=self._version,
            window=due.window.m,
            iterate=due.iterate,
            algo=self._algo,
            architecture=algorithm.architecture,
            weights=weights,
            sha256=digest,
            created_ns=created_ns,
        )
        self._outbox.put(policy)

    def announce(self, entered: PhaseEntered, spec: Spec) -> None:
        """Tell everybody that a phase began."""
        window = entered.window
        notice = WindowNotice(
            window=window.m,
            start_unit=window.start,
            update_units=window.update,
            hold_units=window.hold,
            phase=entered.phase,
            at_ns=spec.t0_ns + entered.start_ns,
            reason=entered.reason,
        )
        self._notices.append(notice)
        self._ledger.windows(self._notices)
        self.check()
        self._outbox.put(notice)

    def check(self) -> None:
        """Hold the stamps against the phases as announced: `published_in_hold` must stay 0."""
        in_hold = sum(announced_phase(self._notices, stamp) == "hold" for stamp in self._created_ns)
        self._ledger.set_counter("published_in_hold", in_hold)

    def withhold(self, window: int, iterate: int, now_ns: int) -> None:
        """Account for an iterate that came too late."""
        if self.improved:
            self._ledger.count("withheld")
            self._ledger.event(now_ns, "INFO", f"window {window}, iterate {iterate}: not published in time")


def announced_phase(notices: Sequence[WindowNotice], at_ns: int) -> Phase:
    """The phase at an instant, by the notices alone, oldest first; before the first it is an update phase.

    A stamp on the boundary belongs to the phase that ends there (stamp <= t_m + G_m).
    """
    before = bisect_left(notices, at_ns, key=lambda notice: notice.at_ns)
    return notices[before - 1].phase if before else "update"
