"""Which policy acts next: checks what arrives, keeps the newest good one ready for the swap.

Runs beside acting, never in it: the acting thread only takes a reference (`take`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from agent_service.inference import ActingPolicy, Array, TanhGaussianPolicy
from agent_service.tables import CategoricalPolicy
from rtcore.ledger import Ledger
from rtcore.messages import Policy, Spec
from rtcore.signing import NoVerifier, Verifier
from rtcore.spaces import Spaces
from rtcore.weights import WeightsError, verify


class Adoption:
    """Candidates for the swap. One thread offers, one takes.

    Counts `policies.received`, `.rejected` and `.superseded` (replaced by a newer one before it acted);
    a repeat of the newest version, which a late or reconnected reader gets, counts as `.repeated` alone.
    """

    def __init__(
        self,
        spec: Spec,
        ledger: Ledger,
        verifier: Verifier | None = None,
        keep: Callable[[Policy], None] | None = None,
    ) -> None:
        """`verifier` checks who signed a policy, None: nobody does; `keep` is given each good new one."""
        self._keep = keep
        self._verifier = verifier or NoVerifier()
        self._spaces = Spaces.of(spec)
        self._ledger = ledger
        self._low: Array = np.asarray(spec.action_low, np.float32)
        self._high: Array = np.asarray(spec.action_high, np.float32)
        self._newest_version = 0
        # One place; pop and append are atomic, so the two threads need no lock.
        self._ready: deque[tuple[ActingPolicy, Policy]] = deque()

    def offer(self, policy: Policy, now_ns: int) -> None:
        """Check a policy and make it ready; a bad one is refused, counted and reported."""
        if policy.version == self._newest_version:
            self._ledger.count("policies.repeated")
            return
        self._ledger.count("policies.received")
        try:
            ready = self._prepare(policy)
        except WeightsError as error:
            self._ledger.count("policies.rejected")
            self._ledger.event(now_ns, "WARN", f"policy {policy.version} refused: {error}")
            return
        self._newest_version = policy.version
        if self.take() is not None:
            self._ledger.count("policies.superseded")
        self._ready.append((ready, policy))
        if self._keep is not None:
            self._keep(policy)

    def take(self) -> tuple[ActingPolicy, Policy] | None:
        """The policy that is ready for the swap, once."""
        try:
            return self._ready.pop()
        except IndexError:
            return None

    def _prepare(self, policy: Policy) -> ActingPolicy:
        if policy.version < self._newest_version:
            raise WeightsError(f"version {self._newest_version} was there before")
        self._verifier.check(policy)
        arrays = verify(policy, self._spaces)
        if self._spaces.finite:
            return CategoricalPolicy(policy.version, arrays["probability"])
        ready = TanhGaussianPolicy(policy.version, policy.architecture, arrays, self._low, self._high)
        ready.warm_up()
        return ready
