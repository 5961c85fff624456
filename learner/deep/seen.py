"""What an update saw, for the gauges: tensors, from which numbers are fetched only when somebody asks."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(slots=True)
class Seen:
    """Of the newest update; None as long as there was nothing.

    Attributes:
        d_q: gradient of J(Q) in the critics' outputs, [2, B, 1]: their errors over B.
        target: what the critics learn, [B].
        value: Q that the policy climbs, [B].
        soft: alpha log pi there, [B].
        log_prob: log pi of the policy's actions, [B].
    """

    d_q: Tensor | None = None
    target: Tensor | None = None
    value: Tensor | None = None
    soft: Tensor | None = None
    log_prob: Tensor | None = None

    def metrics(self) -> dict[str, float]:
        """Loss/critic, q_mean, loss/actor and entropy of `Sac.metrics`."""
        found: dict[str, float] = {}
        if self.d_q is not None and self.target is not None:
            error = self.d_q * len(self.target)
            found["loss/critic"] = 0.5 * error.square().mean(1).sum().item()
            found["q_mean"] = (error + self.target[:, None]).mean().item()
        if self.value is not None and self.soft is not None:
            found["loss/actor"] = (self.soft - self.value).mean().item()
        if self.log_prob is not None:
            found["entropy"] = -self.log_prob.mean().item()
        return found
