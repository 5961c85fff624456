"""Learners to measure, their work in floating point operations, and the rates that the machine allows."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from learner.deep.fsac import Fsac
from learner.deep.gradients import propose
from learner.deep.sac import Sac
from learner.replay import Replay
from rtcore.config import ForecastConfig, LearnerConfig
from rtcore.windows import Window

TRANSITIONS = 5000
GEMM_SIZE = 1024

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Size:
    """The problem's and the networks'; the dimensions are HalfCheetah's."""

    observation_dim: int = 17
    action_dim: int = 6
    hidden: tuple[int, ...] = (256, 256)
    batch: int = 256


def critic_flops(size: Size, *, nets: int = 2) -> int:
    """Of the policy's climb of `nets` critics: forward, and back to the action."""
    widths = _products([size.observation_dim + size.action_dim, *size.hidden, 1])
    back = sum(widths) - widths[0] + size.hidden[0] * size.action_dim
    return 2 * size.batch * nets * (sum(widths) + back)


def policy_flops(size: Size, *, critics: int = 2) -> int:
    """Of a policy step: the actor forward, its gradients, and the climb of so many critics."""
    actor = _products([size.observation_dim, *size.hidden, 2 * size.action_dim])
    return 2 * size.batch * (3 * sum(actor) - actor[0]) + critic_flops(size, nets=critics)


def value_flops(size: Size) -> int:
    """Of a step of both critics: next action, targets, critics forward, and their gradients."""
    critic = _products([size.observation_dim + size.action_dim, *size.hidden, 1])
    actor = _products([size.observation_dim, *size.hidden, 2 * size.action_dim])
    total = sum(actor) + 2 * sum(critic) + 2 * (3 * sum(critic) - critic[0])
    return 2 * size.batch * total


def _products(widths: Sequence[int]) -> list[int]:
    return [width * out for width, out in pairwise(widths)]


def random_transitions(size: Size) -> dict[str, Floats]:
    """The data that all contenders learn from."""
    rng = np.random.default_rng(0)
    shape = (TRANSITIONS, size.observation_dim)
    return {
        "observation": rng.standard_normal(shape, np.float32),
        "action": rng.uniform(-1, 1, (TRANSITIONS, size.action_dim)).astype(np.float32),
        "reward": rng.standard_normal(TRANSITIONS, np.float32),
        "next_observation": rng.standard_normal(shape, np.float32),
    }


def make_replay(size: Size, data: dict[str, Floats]) -> Replay:
    """Those transitions, remembered."""
    replay = Replay(TRANSITIONS, size.observation_dim, size.action_dim)
    for s, a, r, s_next in zip(*data.values(), strict=True):
        replay.add(s, a, float(r), s_next, False, 0)
    return replay


class MeasuredSac(Sac):
    """SAC whose parts can be run alone."""

    def policy_step(self) -> None:
        """What `update` does for the policy, on the batch that was drawn last, at a temperature of 0.2."""
        self._now.input.copy_(self._sampled.observation)
        heads = self._now.forward(self._actor_net)[0]
        noise = torch.from_numpy(self._noise[: self._config.batch])
        self._actor_step(0.2, propose(heads, noise))


class MeasuredFsac(MeasuredSac, Fsac):
    """FSAC, likewise."""


def make_sac(size: Size, config: LearnerConfig, replay: Replay, seed: int = 0) -> MeasuredSac:
    """A SAC of that size; `config` says the rest."""
    config = replace(config, algo="sac", hidden=size.hidden, batch=size.batch)
    return MeasuredSac(config, size.observation_dim, size.action_dim, seed, replay)


def make_fsac(
    size: Size, config: LearnerConfig, replay: Replay, snapshots: int, *, distil: bool = False
) -> MeasuredFsac:
    """An FSAC in a window of ten units, against a forecast of so many snapshots."""
    forecast = ForecastConfig(l_p=snapshots, distil=distil)
    config = replace(config, algo="fsac", hidden=size.hidden, batch=size.batch, forecast=forecast)
    fsac = MeasuredFsac(config, size.observation_dim, size.action_dim, 0, replay)
    for unit in range(snapshots):
        fsac.update(improve_policy=True)
        fsac.end_unit(unit)
    fsac.begin_window(Window(m=1, start=snapshots, update=10, hold=0), snapshots)
    return fsac


def gemm_rate(precision: torch.dtype) -> float:
    """Floating point operations per CPU second in large matrix products."""
    a, b = (torch.randn(GEMM_SIZE, GEMM_SIZE).to(precision) for _ in range(2))
    out = torch.empty_like(a)
    torch.mm(a, b, out=out)
    times = []
    for _ in range(6):
        begin = time.process_time()
        torch.mm(a, b, out=out)
        times.append(time.process_time() - begin)
    return 2 * GEMM_SIZE**3 / min(times)
