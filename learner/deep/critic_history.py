"""Past critics, the material of a forecast."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray

from learner.deep.gradients import Mlp
from learner.deep.networks import FlatParameters


class Snapshot:
    """The twin critics as they were at one instant. Nothing writes to them again, aliases aside.

    Attributes:
        time: the unit at whose beginning the critics were so: t + 1 for the end of unit t.
        parameters: memory of the snapshot's own, or the live critics' if it is an alias.
        net: the same, ready for products.
    """

    def __init__(self, time: int, parameters: FlatParameters, net: Mlp) -> None:
        self.time, self.parameters, self.net = time, parameters, net


class CriticHistory:
    """The newest `length` snapshots, oldest first.

    True copies, as a forecast needs them; or aliases of the live critics, as the public code of the paper's
    authors keeps them, where a list of references makes every past critic the present one.
    """

    def __init__(self, length: int, critic: FlatParameters, net: Mlp, *, aliases: bool = False) -> None:
        """
        Args:
            length: how many are kept.
            critic: the live twin critics.
            net: the same, ready for products.
            aliases: keep no copies.
        """
        self._length, self._critic, self._net, self._aliases = length, critic, net, aliases
        self.snapshots: tuple[Snapshot, ...] = ()

    def take(self, time: int) -> Snapshot:
        """The critics now, as of `time`; not kept."""
        if self._aliases:
            return Snapshot(time, self._critic, self._net)
        parameters = self._critic.frozen_copy()
        return Snapshot(time, parameters, Mlp(parameters, self._net.weights[0].dtype))

    def push(self, time: int) -> None:
        """Keep the critics now, as of `time`.

        Snapshots that are not older than `time` are dropped: the unit ended a second time, after a
        restart that went back.
        """
        older = tuple(snapshot for snapshot in self.snapshots if snapshot.time < time)
        self.restore((*older, self.take(time)))

    def restore(self, snapshots: tuple[Snapshot, ...]) -> None:
        """Hold the newest of `snapshots`, which come oldest first."""
        self.snapshots = snapshots[-self._length :]

    # -- durability

    def tensors(self, snapshot: Snapshot) -> dict[str, NDArray[Any]]:
        """What a checkpoint keeps of it, as copies; nothing of an alias."""
        views = {} if self._aliases else snapshot.parameters.views(snapshot.parameters.flat)
        return {_tensor_name(snapshot.time, name): view.numpy().copy() for name, view in views.items()}

    def expected(self, time: int) -> dict[str, NDArray[Any]]:
        """Arrays of the shapes that `tensors` would give for the snapshot of `time`."""
        views = {} if self._aliases else self._critic.views(self._critic.flat)
        return {_tensor_name(time, name): view.numpy() for name, view in views.items()}

    def saved(self, time: int, tensors: dict[str, NDArray[Any]]) -> Snapshot:
        """The snapshot of `time` in a checkpoint's tensors."""
        snapshot = self.take(time)
        if not self._aliases:
            for name, view in snapshot.parameters.views(snapshot.parameters.flat).items():
                view.copy_(torch.from_numpy(tensors[_tensor_name(time, name)].copy()))
            snapshot.net.refresh()
        return snapshot


def _tensor_name(time: int, name: str) -> str:
    return f"history.{time}.{name}"
