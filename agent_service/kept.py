"""The newest policy that this host knows of, for an agent that starts again, maybe beside no learner.

Older ones than this, or than the newest that an earlier life of the agent took, are refused: so nobody can
bring an old policy back by replaying it.
"""

from __future__ import annotations

import msgspec

from agent_service.adoption import FOREIGN, NEWEST, Past
from rtcore import channels, tally
from rtcore.clock import Clock
from rtcore.files import write_atomic
from rtcore.ledger import Ledger
from rtcore.messages import Policy
from rtcore.run_dir import RunDir
from rtcore.signing import Verifier
from rtcore.weights import WeightsError


class Kept:
    """Two files: the learner's, where it is on this host, and otherwise the agent's own."""

    def __init__(
        self, run_dir: RunDir, ledger: Ledger, clock: Clock, verifier: Verifier, agent: str = channels.AGENT
    ) -> None:
        """`agent` is the process's name."""
        self._run_dir = run_dir
        self._agent = agent
        self._ledger = ledger
        self._clock = clock
        self._verifier = verifier

    def past(self) -> Past:
        """What an agent that begins now goes on from."""
        return Past(self.newest(), self.floor(), self.keep)

    def floor(self) -> int:
        """The newest version that an earlier life of the agent took; 0: none did."""
        tallies = self._run_dir.logs_dir.glob(f"{self._agent}-*.tally")
        for path in sorted(tallies, key=lambda path: (len(path.name), path.name), reverse=True):
            try:
                version = tally.read(path).get(NEWEST, 0)
            except OSError as error:
                self._say(f"{path.name} cannot be read: {error}")
                continue
            if version:  # no life takes an older one than the life before
                return version
        return 0

    def newest(self) -> Policy | None:
        """The newest one whose signature is right; another is refused, counted and reported."""
        found = (self._run_dir.read_policy(), self._run_dir.read_adopted(self._agent))
        good = [policy for policy in found if policy is not None and self._is_right(policy)]
        return max(good, key=lambda policy: policy.version, default=None)

    def keep(self, policy: Policy) -> None:
        """Write it down, unless the learner has; off the acting thread, it waits for the disk.

        The learner's file may be there and older: of an earlier run on this host, or its disk is full.
        """
        learners = self._run_dir.read_policy()
        if learners is not None and learners.version >= policy.version and self._flaw(learners) is None:
            return
        path = self._run_dir.adopted_path(self._agent)
        try:
            path.parent.mkdir(exist_ok=True)
            write_atomic(path, msgspec.msgpack.encode(policy))
        except OSError as error:
            self._ledger.count("policy_file.errors")
            self._say(f"policy {policy.version} not on disk: {error}")

    def _is_right(self, policy: Policy) -> bool:
        flaw = self._flaw(policy)
        if flaw is None:
            return True
        self._ledger.count(FOREIGN)
        self._say(f"policy {policy.version} from a file refused: {flaw}")
        return False

    def _flaw(self, policy: Policy) -> WeightsError | None:
        """Why it is not the learner's; None: it is."""
        try:
            self._verifier.check(policy)
        except WeightsError as error:
            return error
        return None

    def _say(self, text: str) -> None:
        self._ledger.event(self._clock.now_ns(), "WARN", text)
