"""How many gradient steps a second does the learner make, and how many could it make?

    python -m benchmarks.update_rate --rounds 9

One process, one thread, the contenders by turns in every round: Tenuto's SAC (with the policy, and as
in a hold), its FSAC against a forecast, and stable-baselines3's SAC with the same networks, batch and
rates on the same transitions. The floor is the time that one update's matrix products alone take at the
rate that torch reaches on large ones, measured in the same rounds. Rates are per CPU second, so that
other work on the machine distorts them less; the wall rate stands beside them.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
import tyro
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger

from learner.fsac import Fsac
from learner.memory import keep_freed_memory
from learner.replay import Replay
from learner.sac import Sac
from rtcore.config import ForecastConfig, LearnerConfig
from rtcore.windows import Window

TRANSITIONS = 5000
WARM_UP = 20
GEMM_SIZE = 1024
PEER = "stable-baselines3 SAC"


@dataclass(frozen=True)
class Arguments:
    """What to measure; the dimensions are HalfCheetah's."""

    observation_dim: int = 17
    action_dim: int = 6
    hidden: tuple[int, ...] = (256, 256)
    batch: int = 256
    snapshots: tuple[int, ...] = (5, 10)  # l_p of the FSAC rows
    rounds: int = 9
    updates: int = 40  # per contender and round
    keep_memory: bool = True  # as the learner process does: learner.memory
    out: Path = Path("benchmarks/results")


@dataclass(frozen=True)
class Contender:
    """Something that makes updates.

    Attributes:
        flops: of the matrix products that one of its updates cannot do without.
        run: make so many updates.
    """

    name: str
    flops: int
    run: Callable[[int], None]


def update_flops(arguments: Arguments, *, policy: bool, snapshots: int = 1) -> int:
    """Floating point operations in the matrix products of one update.

    Targets, critics (forward, weights, inputs of all layers but the first) and the next action; with
    `policy` also the actor (likewise) and, per snapshot, twin critics forward and back to the action.
    """
    critic = _products([arguments.observation_dim + arguments.action_dim, *arguments.hidden, 1])
    actor = _products([arguments.observation_dim, *arguments.hidden, 2 * arguments.action_dim])
    total = 2 * sum(critic) + 2 * (3 * sum(critic) - critic[0]) + sum(actor)
    if policy:
        total += (3 * sum(actor) - actor[0]) + snapshots * 2 * 2 * sum(critic)
    return 2 * arguments.batch * total


def _products(widths: Sequence[int]) -> list[int]:
    return [width * out for width, out in pairwise(widths)]


def random_transitions(arguments: Arguments) -> dict[str, NDArray[np.float32]]:
    """The data that all contenders learn from."""
    rng = np.random.default_rng(0)
    shape = (TRANSITIONS, arguments.observation_dim)
    return {
        "observation": rng.standard_normal(shape, np.float32),
        "action": rng.uniform(-1, 1, (TRANSITIONS, arguments.action_dim)).astype(np.float32),
        "reward": rng.standard_normal(TRANSITIONS, np.float32),
        "next_observation": rng.standard_normal(shape, np.float32),
    }


def our_contenders(arguments: Arguments, data: dict[str, NDArray[np.float32]]) -> list[Contender]:
    """Tenuto's SAC twice, improving and holding, and FSAC once per number of snapshots."""
    replay = Replay(TRANSITIONS, arguments.observation_dim, arguments.action_dim)
    for s, a, r, s_next in zip(*data.values(), strict=True):
        replay.add(s, a, float(r), s_next, False, 0)
    config = LearnerConfig(algo="sac", hidden=arguments.hidden, batch=arguments.batch)
    dims = (arguments.observation_dim, arguments.action_dim)
    found = [
        Contender("tenuto SAC", update_flops(arguments, policy=True), _runner(Sac(config, *dims, 0, replay))),
        Contender(
            "tenuto SAC, hold",
            update_flops(arguments, policy=False),
            _runner(Sac(config, *dims, 0, replay), improve=False),
        ),
    ]
    for count in arguments.snapshots:
        fsac = Fsac(replace(config, algo="fsac", forecast=ForecastConfig(l_p=count)), *dims, 0, replay)
        for unit in range(count):
            fsac.update(improve_policy=True)
            fsac.end_unit(unit)
        fsac.begin_window(Window(m=1, start=count, update=10, hold=0), count)
        flops = update_flops(arguments, policy=True, snapshots=count)
        found.append(Contender(f"tenuto FSAC, l_p = {count}", flops, _runner(fsac)))
    return found


def _runner(student: Sac, *, improve: bool = True) -> Callable[[int], None]:
    def run(updates: int) -> None:
        for _ in range(updates):
            student.update(improve_policy=improve)

    return run


class _Shapes(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Only the spaces: nothing steps it."""

    def __init__(self, arguments: Arguments) -> None:
        self.observation_space = gymnasium.spaces.Box(
            -np.inf, np.inf, (arguments.observation_dim,), np.float32
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (arguments.action_dim,), np.float32)


def peer(arguments: Arguments, data: dict[str, NDArray[np.float32]]) -> Contender:
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
    return Contender(
        PEER, update_flops(arguments, policy=True), lambda updates: model.train(updates, arguments.batch)
    )


def measure_gemm() -> float:
    """Floating point operations per CPU second in large matrix products."""
    a, b = torch.randn(GEMM_SIZE, GEMM_SIZE), torch.randn(GEMM_SIZE, GEMM_SIZE)
    out = torch.empty(GEMM_SIZE, GEMM_SIZE)
    times = []
    for _ in range(6):
        begin = time.process_time()
        torch.mm(a, b, out=out)
        times.append(time.process_time() - begin)
    return 2 * GEMM_SIZE**3 / min(times)


def measure(contenders: Sequence[Contender], arguments: Arguments) -> tuple[list[dict[str, Any]], float]:
    """One row per contender, and the rate of matrix products; all by turns."""
    cpu: dict[str, list[float]] = {contender.name: [] for contender in contenders}
    wall: dict[str, list[float]] = {contender.name: [] for contender in contenders}
    gemm = []
    for contender in contenders:
        contender.run(WARM_UP)
    for _ in range(arguments.rounds):
        gemm.append(measure_gemm())
        for contender in contenders:
            begin_wall, begin_cpu = time.perf_counter(), time.process_time()
            contender.run(arguments.updates)
            cpu[contender.name].append(arguments.updates / (time.process_time() - begin_cpu))
            wall[contender.name].append(arguments.updates / (time.perf_counter() - begin_wall))
    rate = statistics.median(gemm)
    rows = []
    for contender in contenders:
        mine = cpu[contender.name]
        ratios = [ours / theirs for ours, theirs in zip(mine, cpu[PEER], strict=True)]
        rows.append({
            "name": contender.name,
            "updates_per_cpu_s": statistics.median(mine),
            "updates_per_s": statistics.median(wall[contender.name]),
            "ratio_to_peer": statistics.median(ratios),
            "flops": contender.flops,
            "floor_updates_per_s": rate / contender.flops,
            "share_of_floor": statistics.median(mine) * contender.flops / rate,
            "rounds_per_cpu_s": mine,
        })  # fmt: skip
    return rows, rate


def table(rows: Sequence[dict[str, Any]]) -> str:
    """One line per contender."""
    lines = [f"{'':24} {'per CPU s':>9} {'per s':>7} {'of peer':>8} {'floor':>7} {'of floor':>9}"]
    lines += [
        f"{row['name']:24} {row['updates_per_cpu_s']:9.1f} {row['updates_per_s']:7.1f}"
        f" {row['ratio_to_peer']:7.2f}x {row['floor_updates_per_s']:7.1f} {row['share_of_floor']:9.0%}"
        for row in rows
    ]
    return "\n".join(lines)


def main(arguments: Arguments) -> None:
    """Measure, print the table, write the result."""
    torch.set_num_threads(1)
    kept = arguments.keep_memory and keep_freed_memory()
    data = random_transitions(arguments)
    rows, rate = measure([*our_contenders(arguments, data), peer(arguments, data)], arguments)
    print(f"matrix products: {rate / 1e9:.0f} GFLOP/s; freed memory kept: {kept}")
    print(table(rows))
    found = {
        "benchmark": "update_rate",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {"torch": torch.__version__, "stable_baselines3": stable_baselines3.__version__},
        "arguments": asdict(replace(arguments, keep_memory=kept)) | {"out": str(arguments.out)},
        "gemm_flops_per_cpu_s": rate,
        "rows": rows,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{datetime.now(UTC):%Y-%m-%d}-update_rate.json"
    path.write_text(json.dumps(found, indent=1) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
