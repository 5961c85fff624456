"""How many gradient steps a second does the learner make, and how many could it make?

    python -m benchmarks.update_rate --rounds 9

One process, one thread, the contenders by turns in every round, in each precision: Tenuto's SAC (with the
policy, and as in a hold), its FSAC against a forecast and against a distilled one, and stable-baselines3's
SAC with the same networks, batch and rates on the same transitions. Then the policy's step alone: the
actor's pass, the climb of the critics or of the forecast, the gradient, the optimiser.

The floor is the time that the matrix products alone take at the rate that torch reaches on large ones in
that precision, measured in the same rounds. Rates are per CPU second, so that other work on the machine
distorts them less; the wall rate stands beside them. The distilled forecast is measured after its first
exact steps, with those that it takes every so many afterwards; the first ones cost what the forecast does.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import stable_baselines3
import torch
import tyro
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger

from benchmarks.learners import (
    TRANSITIONS,
    Floats,
    MeasuredSac,
    Size,
    gemm_rate,
    make_fsac,
    make_replay,
    make_sac,
    policy_flops,
    random_transitions,
    value_flops,
)
from learner.arithmetic import product_type
from learner.deep.distil import FIRST_FITS, FIT_EVERY
from learner.deep.sac import Sac
from learner.memory import keep_freed_memory
from learner.replay import Replay
from rtcore.config import LearnerConfig, Precision

WARM_UP = 20
PEER = "stable-baselines3 SAC"

Kind = Literal["update", "policy step"]


@dataclass(frozen=True)
class Arguments(Size):
    """What to measure."""

    precisions: tuple[Precision, ...] = ("float32", "bfloat16")
    snapshots: tuple[int, ...] = (5, 10, 20)  # l_p of the forecasts
    distilled: int = 10  # l_p of the forecast that is distilled
    rounds: int = 9
    updates: int = 2 * FIT_EVERY  # per contender and round; the distilled forecast's exact steps fit in
    keep_memory: bool = True  # as the learner process does: learner.memory
    out: Path = Path("benchmarks/results")


@dataclass(frozen=True)
class Contender:
    """Something that makes updates, or steps of the policy alone.

    Attributes:
        flops: of the matrix products that one of them cannot do without.
        run: make so many.
    """

    name: str
    kind: Kind
    precision: Precision
    flops: float
    run: Callable[[int], None]


def our_contenders(arguments: Arguments, precision: Precision, replay: Replay) -> list[Contender]:
    """Tenuto's in one precision: SAC improving and holding, FSAC, and the policy's step of each."""
    config = LearnerConfig(precision=precision)
    value, plain = value_flops(arguments), policy_flops(arguments)
    sac = make_sac(arguments, config, replay)
    holding = make_sac(arguments, config, replay)
    found = [
        Contender("SAC", "update", precision, value + plain, _updates(sac)),
        Contender("SAC, hold", "update", precision, value, _updates(holding, improve=False)),
        Contender("SAC", "policy step", precision, plain, _policy_steps(sac)),
    ]
    students = [
        (f"FSAC, l_p = {count}", make_fsac(arguments, config, replay, count),
         float(policy_flops(arguments, critics=2 * count)))
        for count in arguments.snapshots
    ]  # fmt: skip
    distilled = make_fsac(arguments, config, replay, arguments.distilled, distil=True)
    _updates(distilled)(FIRST_FITS + FIT_EVERY - FIRST_FITS % FIT_EVERY)
    exact = policy_flops(arguments, critics=2 * arguments.distilled)
    mean = policy_flops(arguments, critics=1) * (1 - 1 / FIT_EVERY) + exact / FIT_EVERY
    students.append((f"FSAC, l_p = {arguments.distilled}, distilled", distilled, mean))
    for name, student, flops in students:
        found.append(Contender(name, "update", precision, value + flops, _updates(student)))
        found.append(Contender(name, "policy step", precision, flops, _policy_steps(student)))
    return found


def _updates(student: Sac, *, improve: bool = True) -> Callable[[int], None]:
    def run(updates: int) -> None:
        for _ in range(updates):
            student.update(improve_policy=improve)

    return run


def _policy_steps(student: MeasuredSac) -> Callable[[int], None]:
    def run(updates: int) -> None:
        for _ in range(updates):
            student.policy_step()

    return run


class _Shapes(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Only the spaces: nothing steps it."""

    def __init__(self, size: Size) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size.observation_dim,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (size.action_dim,), np.float32)


def peer(arguments: Arguments, data: dict[str, Floats]) -> Contender:
    """stable-baselines3's SAC.train, in calls as long as the blocks."""
    defaults = LearnerConfig()
    model = stable_baselines3.SAC(
        "MlpPolicy", _Shapes(arguments), learning_rate=defaults.critic_lr, buffer_size=TRANSITIONS,
        batch_size=arguments.batch, tau=defaults.tau, gamma=defaults.gamma,
        policy_kwargs={"net_arch": list(arguments.hidden)}, seed=0, device="cpu",
    )  # fmt: skip
    model.set_logger(Logger(folder=None, output_formats=[]))
    buffer = model.replay_buffer
    assert buffer is not None
    no = np.zeros(1, np.bool_)
    for s, a, r, s_next in zip(*data.values(), strict=True):
        buffer.add(s[None], s_next[None], a[None], np.array([r]), no, [{}])
    flops = value_flops(arguments) + policy_flops(arguments)
    run: Callable[[int], None] = lambda updates: model.train(updates, arguments.batch)  # noqa: E731
    return Contender(PEER, "update", "float32", flops, run)


def measure(contenders: Sequence[Contender], arguments: Arguments) -> list[dict[str, Any]]:
    """One row per contender; all by turns, the matrix products as well."""
    cpu: list[list[float]] = [[] for _ in contenders]
    wall: list[list[float]] = [[] for _ in contenders]
    products: dict[Precision, list[float]] = {contender.precision: [] for contender in contenders}
    for contender in contenders:
        contender.run(WARM_UP - WARM_UP % FIT_EVERY)
    for _ in range(arguments.rounds):
        for precision, rates in products.items():
            rates.append(gemm_rate(product_type(precision)))
        for index, contender in enumerate(contenders):
            begin_wall, begin_cpu = time.perf_counter(), time.process_time()
            contender.run(arguments.updates)
            cpu[index].append(arguments.updates / (time.process_time() - begin_cpu))
            wall[index].append(arguments.updates / (time.perf_counter() - begin_wall))
    found = []
    for index, contender in enumerate(contenders):
        rate = statistics.median(products[contender.precision])
        found.append({
            "name": contender.name, "kind": contender.kind, "precision": contender.precision,
            "per_cpu_s": statistics.median(cpu[index]), "per_s": statistics.median(wall[index]),
            "flops": contender.flops, "gemm_flops_per_cpu_s": rate,
            "floor_per_s": rate / contender.flops,
            "share_of_floor": statistics.median(cpu[index]) * contender.flops / rate,
            "rounds_per_cpu_s": cpu[index],
        })  # fmt: skip
    return found


def compare(rows: list[dict[str, Any]]) -> None:
    """Add to each row how it compares: an update with the peer's, a policy step with SAC's in its precision.

    `rate_of_peer` is a ratio of rates, `cost_of_plain` one of times; both medians over the rounds.
    """
    reference = {(row["name"], row["kind"], row["precision"]): row["rounds_per_cpu_s"] for row in rows}
    for row in rows:
        mine = row["rounds_per_cpu_s"]
        theirs = reference[PEER, "update", "float32"]
        plain = reference.get(("SAC", row["kind"], row["precision"]), mine)
        if row["kind"] == "update":
            row["rate_of_peer"] = statistics.median(a / b for a, b in zip(mine, theirs, strict=True))
        row["cost_of_plain"] = statistics.median(b / a for a, b in zip(mine, plain, strict=True))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line per contender."""
    lines = [f"{'':47}{'per CPU s':>10}{'per s':>8}{'of peer':>9}{'cost':>7}{'floor':>8}{'of floor':>9}"]
    for row in rows:
        ratio = f"{row['rate_of_peer']:8.2f}x" if "rate_of_peer" in row else " " * 9
        lines.append(
            f"{row['kind']:12}{row['name']:26}{row['precision']:9}{row['per_cpu_s']:10.1f}{row['per_s']:8.1f}"
            f"{ratio}{row['cost_of_plain']:6.2f}x{row['floor_per_s']:8.1f}{row['share_of_floor']:9.0%}"
        )
    return "\n".join(lines)


def main(arguments: Arguments) -> None:
    """Measure, print the table, write the result."""
    torch.set_num_threads(1)
    kept = arguments.keep_memory and keep_freed_memory()
    data = random_transitions(arguments)
    replay = make_replay(arguments, data)
    contenders = [peer(arguments, data)]
    for precision in arguments.precisions:
        contenders += our_contenders(arguments, precision, replay)
    rows = measure(contenders, arguments)
    compare(rows)
    rows.sort(key=lambda row: str(row["kind"]), reverse=True)
    gemm = {row["precision"]: row["gemm_flops_per_cpu_s"] for row in rows}
    rates = ", ".join(f"{precision} {rate / 1e9:.0f} GFLOP/s" for precision, rate in gemm.items())
    print(f"matrix products: {rates}; freed memory kept: {kept}")
    print(table(rows))
    found = {
        "benchmark": "update_rate",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"torch": torch.__version__, "stable_baselines3": stable_baselines3.__version__},
        "arguments": asdict(replace(arguments, keep_memory=kept)) | {"out": str(arguments.out)},
        "rows": rows,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{datetime.now(UTC):%Y-%m-%d}-update_rate.json"
    path.write_text(json.dumps(found, indent=1) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
