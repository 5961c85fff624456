"""What an algorithm foresees of a window, as far as the choice of its hold needs it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learner.tabular.table import log_normalised

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Outlook:
    """Of a window of W units. S states and A actions are all of a finite world's, or a sample.

    Attributes:
        past: Q as it was, [l, S, A], oldest first.
        times: of these, [l], in units relative to t_m.
        forecasts: Qtilde_{t_m + k}, k = 0 .. W, [W + 1, S, A].
        target: what the policy is improved towards throughout, [S, A].
        log_policy: log pi_{t_m}, [S, A].
        rate: the share of the way to the target that one unit of update takes, in (0, 1].
        temperature: tau; the policy goes to softmax(target / tau). In units of return.
    """

    past: Floats
    times: Floats
    forecasts: Floats
    target: Floats
    log_policy: Floats
    rate: float
    temperature: float

    def policies(self) -> Floats:
        """pi^g, g = 0 .. W, [W + 1, S, A]: with a target that stays, their closed form (paper, section 4).

        pi^g ~ (pi^0)^{(1 - x)^g} exp(target / tau)^{1 - (1 - x)^g},    x the rate.
        """
        kept = (1.0 - self.rate) ** np.arange(len(self.forecasts))[:, None, None]
        made: Floats = np.exp(
            log_normalised(kept * self.log_policy + (1.0 - kept) * self.target / self.temperature)
        )
        return made
