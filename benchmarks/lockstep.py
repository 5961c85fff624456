"""Is it faster to train K learners in lockstep, stacked into one, than each for itself?

    python -m benchmarks.lockstep --rounds 5

One process, one thread. Stacked: K actors and 2K critics side by side, each with its own batch, so that a
product of the update is one batched product for all. Apart: K of Tenuto's learners, an update each by turns,
as K processes on one core would. Both sides have a fixed temperature and the same sizes; the rate is updates
per CPU second, all learners together.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from benchmarks.learners import (
    Size,
    gemm_rate,
    make_replay,
    make_sac,
    policy_flops,
    random_transitions,
    value_flops,
)
from learner.arithmetic import product_type
from learner.deep.gradients import Mlp, Pass, Proposal, policy_loss_to_heads, propose
from learner.deep.networks import Adam, FlatParameters, make_networks
from learner.deep.tensors import BatchTensors
from learner.memory import keep_freed_memory
from learner.replay import Replay, make_batch
from rtcore.config import LearnerConfig, Precision

ALPHA = 0.2


@dataclass(frozen=True)
class Arguments(Size):
    """What to measure."""

    learners: tuple[int, ...] = (1, 8, 36)
    precisions: tuple[Precision, ...] = ("float32", "bfloat16")
    rounds: int = 5
    updates: int = 72  # per side and round, all learners together
    out: Path = Path("benchmarks/results")


class StackedPass(Pass):
    """A pass in which every network has a batch of its own: `own` [n, B, in]."""

    def __init__(self, nets: int, rows: int, widths: Sequence[int], precision: torch.dtype) -> None:
        self.own = torch.zeros(nets, rows, widths[0], dtype=precision)
        super().__init__(nets, rows, widths, precision)

    def _prepare(self) -> None:
        super()._prepare()
        self._below[0] = self.own
        self._below_transposed[0] = self.own.transpose(1, 2)


class Stacked:
    """K SAC learners as one: networks side by side, one optimiser step for all."""

    def __init__(self, size: Size, count: int, precision: torch.dtype, replay: Replay) -> None:
        self._size, self._count, self._replay = size, count, replay
        self._config = LearnerConfig()
        rng = np.random.default_rng(0)
        actor_widths = [size.observation_dim, *size.hidden, 2 * size.action_dim]
        critic_widths = [size.observation_dim + size.action_dim, *size.hidden, 1]
        self._actor, self._actor_net, self._actor_adam = self._trained(count, actor_widths, rng, precision)
        self._critic, self._critic_net, self._critic_adam = self._trained(
            2 * count, critic_widths, rng, precision
        )
        self._target = self._critic.frozen_copy()
        self._target_net = Mlp(self._target, precision)
        self._policy = StackedPass(count, size.batch, actor_widths, precision)
        self._values = StackedPass(2 * count, size.batch, critic_widths, precision)
        self._rng = [np.random.default_rng(seed) for seed in range(count)]
        self._batch = make_batch(size.batch, size.observation_dim, size.action_dim)
        self._drawn = BatchTensors(self._batch)
        rows = (count, size.batch)
        self._observation = torch.zeros(*rows, size.observation_dim)
        self._following = torch.zeros(*rows, size.observation_dim)
        self._action = torch.zeros(*rows, size.action_dim)
        self._reward = torch.zeros(rows)

    def _trained(
        self, nets: int, widths: Sequence[int], rng: np.random.Generator, precision: torch.dtype
    ) -> tuple[FlatParameters, Mlp, Adam]:
        parameters = make_networks(nets, widths, rng)
        adam = Adam(parameters.flat, parameters.grad, self._config.critic_lr)
        return parameters, Mlp(parameters, precision), adam

    def update(self) -> None:
        """One gradient step of every learner."""
        self._sample()
        next_action, next_log_prob, _ = self._propose(self._following)
        value = self._evaluate(self._target_net, self._following, next_action).amin(1)
        target = self._reward + self._config.gamma * (value - ALPHA * next_log_prob)
        q = self._evaluate(self._critic_net, self._observation, self._action)
        d_q = (q - target[:, None]) / self._size.batch
        self._values.to_parameters(self._critic_net, d_q.view(2 * self._count, -1, 1))
        self._critic_adam.step()
        self._critic_net.refresh()
        self._improve()
        self._target.flat.lerp_(self._critic.flat, self._config.tau)
        self._target_net.refresh()

    def _sample(self) -> None:
        kept = (self._observation, self._action, self._reward, self._following)
        drawn = self._drawn
        for index, rng in enumerate(self._rng):
            self._replay.sample(rng, self._batch)
            for to, part in zip(
                kept, (drawn.observation, drawn.action, drawn.reward, drawn.next_observation), strict=True
            ):
                to[index] = part

    def _propose(self, observation: Tensor) -> tuple[Tensor, Tensor, Proposal]:
        """Actions [K, B, A] and log densities [K, B] at `observation`, [K, B, O], and the whole proposal."""
        self._policy.own.copy_(observation)
        heads = self._policy.forward(self._actor_net).view(self._count * self._size.batch, -1)
        noise = np.stack([rng.standard_normal(self._action[0].shape, np.float32) for rng in self._rng])
        proposal = propose(heads, torch.from_numpy(noise).view(len(heads), -1))
        return proposal.action.view_as(self._action), proposal.log_prob.view_as(self._reward), proposal

    def _evaluate(self, net: Mlp, observation: Tensor, action: Tensor) -> Tensor:
        """Values [K, 2, B]: critics 2k and 2k + 1 are learner k's."""
        inputs = torch.cat((observation, action), -1)
        self._values.own.view(self._count, 2, self._size.batch, -1).copy_(inputs[:, None])
        return self._values.forward(net).view(self._count, 2, -1)

    def _improve(self) -> None:
        action, _, proposal = self._propose(self._observation)
        q = self._evaluate(self._critic_net, self._observation, action)
        first = (q[:, :1] <= q[:, 1:]).float()
        selected = torch.cat((first, 1.0 - first), 1).view(2 * self._count, -1, 1)
        slopes = self._values.to_input(self._critic_net, selected, self._size.action_dim)
        slope = slopes.view(self._count, 2, *slopes.shape[1:]).sum(1, dtype=torch.float32)
        d_heads = policy_loss_to_heads(proposal, slope.view_as(proposal.action), ALPHA) * self._count
        self._policy.to_parameters(self._actor_net, d_heads.view(self._count, self._size.batch, -1))
        self._actor_adam.step()
        self._actor_net.refresh()


def sides(
    arguments: Arguments, precision: Precision, count: int, replay: Replay
) -> dict[str, Callable[[], None]]:
    """One round's work of both sides: an update of each of `count` learners."""
    stacked = Stacked(arguments, count, product_type(precision), replay)
    config = LearnerConfig(precision=precision, alpha=ALPHA)
    apart = [make_sac(arguments, config, replay, seed) for seed in range(count)]

    def each() -> None:
        for student in apart:
            student.update(improve_policy=True)

    return {"stacked": stacked.update, "apart": each}


def measure(arguments: Arguments, precision: Precision, count: int, replay: Replay) -> dict[str, Any]:
    """One row: the rates of both sides, by turns, and their ratio."""
    contenders = sides(arguments, precision, count, replay)
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    turns = max(1, arguments.updates // count)
    for run in contenders.values():
        run()
    products = []
    for _ in range(arguments.rounds):
        products.append(gemm_rate(product_type(precision)))
        for name, run in contenders.items():
            begin = time.process_time()
            for _ in range(turns):
                run()
            rates[name].append(turns * count / (time.process_time() - begin))
    floor = statistics.median(products) / (value_flops(arguments) + policy_flops(arguments))
    ratios = [a / b for a, b in zip(rates["stacked"], rates["apart"], strict=True)]
    return {
        "learners": count, "precision": precision,
        "stacked_per_cpu_s": statistics.median(rates["stacked"]),
        "apart_per_cpu_s": statistics.median(rates["apart"]),
        "ratio": statistics.median(ratios), "floor_per_s": floor, "rounds_per_cpu_s": rates,
    }  # fmt: skip


def main(arguments: Arguments) -> None:
    """Measure, print the table, write the result."""
    torch.set_num_threads(1)
    kept = keep_freed_memory()
    replay = make_replay(arguments, random_transitions(arguments))
    print(f"{'':10}{'K':>4}{'stacked':>10}{'apart':>10}{'ratio':>8}{'floor':>8}   per CPU s, all learners")
    rows = []
    for precision in arguments.precisions:
        for count in arguments.learners:
            row = measure(arguments, precision, count, replay)
            rows.append(row)
            print(
                f"{precision:10}{count:4}{row['stacked_per_cpu_s']:10.1f}{row['apart_per_cpu_s']:10.1f}"
                f"{row['ratio']:7.2f}x{row['floor_per_s']:8.1f}"
            )
    found = {
        "benchmark": "lockstep",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"torch": torch.__version__},
        "freed_memory_kept": kept,
        "arguments": asdict(arguments) | {"out": str(arguments.out)},
        "rows": rows,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{datetime.now(UTC):%Y-%m-%d}-lockstep.json"
    path.write_text(json.dumps(found, indent=1) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
