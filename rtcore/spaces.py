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
    """

    observation_dim: int
    action_dim: int
    states: int = 0
    actions: int = 0

    @staticmethod
    def of(spec: Spec) -> Spaces:
        """Those that an env server has declared."""
        return Spaces(spec.observation_dim, spec.action_dim, spec.states, spec.actions)

    @property
    def finite(self) -> bool:
        """Whether states and actions are numbered, so that tables fit."""
        return self.states > 0
