"""Which policy acts next: checks what arrives, keeps the newest good one ready for the swap.

Runs beside acting, never in it: the acting thread only takes a reference (`take`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agent_service.inference import ActingPolicy, Array, TanhGaussianPolicy
from agent_service.tables import CategoricalPolicy
from rtcore.ledger import Ledger
from rtcore.messages import Policy, Spec
from rtcore.signing import NoVerifier, Verifier
from rtcore.spaces import Spaces
from rtcore.weights import WeightsError, verify

# Counters: the first and the newest version that this life took, and policies that were not the learner's.
FIRST, NEWEST, FOREIGN = "policies.first", "policies.newest", "policies.foreign"
COMPLAINT_NS = 1_000_000_000  # at most one line in so long about refused policies


@dataclass(frozen=True, slots=True)
class Past:
    """What earlier lives of the run's processes leave to this one, and it to later ones.

    Attributes:
        newest: the newest policy that this host knows of.
        floor: the newest version that an earlier life of the agent took; older ones are refused.
        keep: is given each good new policy, before it may act; None: nobody keeps it.
    """

    newest: Policy | None = None
    floor: int = 0
    keep: Callable[[Policy], None] | None = None

    @property
    def known(self) -> int:
        """The newest version that was there before this life; 0: none was."""
        return max(self.floor, self.newest.version if self.newest is not None else 0)


class Adoption:
    """Candidates for the swap. One thread offers, one takes.

    Counts `policies.received`, `.rejected` and `.superseded` (replaced by a newer one before it acted);
    a repeat of the newest version, which a late or reconnected reader gets, counts as `.repeated` alone. One
    that is older than the newest is rejected and counts as `.past` besides: it was there before. One that the
    verifier refuses was never the learner's: it counts as `.foreign` alone.
    """

    def __init__(
        self,
        spec: Spec,
        ledger: Ledger,
        verifier: Verifier | None = None,
        past: Past | None = None,
    ) -> None:
        """`verifier` checks who signed a policy, None: nobody does."""
        self._past = past or Past()
        self._verifier = verifier or NoVerifier()
        self._spaces = Spaces.of(spec)
        self._ledger = ledger
        self._low: Array = np.asarray(spec.action_low, np.float32)
        self._high: Array = np.asarray(spec.action_high, np.float32)
        self._newest_version = 0
        self._complaint_due_ns = 0
        # One place; pop and append are atomic, so the two threads need no lock.
        self._ready: deque[tuple[ActingPolicy, Policy]] = deque()

    @property
    def newest_version(self) -> int:
        """Of the policies that were good; 0: there was none."""
        return self._newest_version

    def offer(self, policy: Policy, now_ns: int) -> None:
        """Check a policy and make it ready; a bad one is refused, counted and reported."""
        try:
            self._verifier.check(policy)
        except WeightsError as error:
            self._ledger.count(FOREIGN)
            self._complain(now_ns, f"policy {policy.version} refused: {error}")
            return
        if policy.version == self._newest_version:
            self._ledger.count("policies.repeated")
            return
        known = max(self._newest_version, self._past.floor)
        if policy.version < known:
            self._ledger.count_together("policies.received", "policies.rejected", "policies.past")
            self._complain(now_ns, f"policy {policy.version} refused: version {known} was there before")
            return
        try:
            ready = self._prepare(policy)
        except WeightsError as error:
            self._ledger.count_together("policies.received", "policies.rejected")
            self._complain(now_ns, f"policy {policy.version} refused: {error}")
            return
        # Nothing acts that a later life would not know of.
        if self._past.keep is not None:
            self._past.keep(policy)
        self._newest_version = policy.version
        self._count(policy.version)
        if self.take() is not None:
            self._ledger.count("policies.superseded")
        self._ready.append((ready, policy))

    def _count(self, version: int) -> None:
        """As received, with what a summary over several lives needs: a later one gets the newest again, and
        whether this one had it must not depend on when it was killed.
        """
        first = self._ledger.counter(FIRST) or version
        self._ledger.count_together("policies.received", values={FIRST: first, NEWEST: version})

    def _complain(self, now_ns: int, text: str) -> None:
        """Report a refusal, if none was in the last second; all are counted."""
        if now_ns >= self._complaint_due_ns:
            self._complaint_due_ns = now_ns + COMPLAINT_NS
            self._ledger.event(now_ns, "WARN", text)

    def take(self) -> tuple[ActingPolicy, Policy] | None:
        """The policy that is ready for the swap, once."""
        try:
            return self._ready.pop()
        except IndexError:
            return None

    def _prepare(self, policy: Policy) -> ActingPolicy:
        arrays = verify(policy, self._spaces)
        if self._spaces.finite:
            return CategoricalPolicy(policy.version, arrays["probability"])
        ready = TanhGaussianPolicy(policy.version, policy.architecture, arrays, self._low, self._high)
        ready.warm_up()
        return ready
