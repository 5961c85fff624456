"""What an agent observes and does: the sizes that policies, tables and networks are built from."""

from __future__ import annotations

from dataclasses import dataclass

from rtcore.messages import Spec


@dataclass(frozen=True, slots=True)
class Spaces:
    """Observations and actions of one environment.

    Attributes:
        observation_dim: numbers in an observation.
        action_dim: numbers in an action.
        states: of a finite world, whose observation is one number, the state's; 0: continuous.
        actions: of a finite world, likewise; 0: continuous.
        action_low: least action in the environment's own units, one per entry; empty: -1.
        action_high: greatest, likewise; empty: 1.
    """

    observation_dim: int
    action_dim: int
    states: int = 0
    actions: int = 0
    action_low: tuple[float, ...] = ()
    action_high: tuple[float, ...] = ()

    @staticmethod
    def of(spec: Spec) -> Spaces:
        """Those that an env server has declared."""
        return Spaces(
            spec.observation_dim,
            spec.action_dim,
            spec.states,
            spec.actions,
            tuple(spec.action_low),
            tuple(spec.action_high),
        )

    @property
    def finite(self) -> bool:
        """Whether states and actions are numbered, so that tables fit."""
        return self.states > 0
