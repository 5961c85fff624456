"""How PyTorch works in this process; settled once, before the first gradient step."""

from __future__ import annotations

import torch

from learner.memory import keep_freed_memory
from rtcore.config import Precision


def prepare(threads: int) -> None:
    """Give PyTorch so many threads, and keep what it frees.

    One thread gives bit-equal results, and leaves the other core to the tick: with two on two cores the
    wake-up error's p99 was 7.3 ms instead of 1.8 ms.
    """
    set_threads(threads)
    keep_freed_memory()


def set_threads(threads: int) -> None:
    """Give PyTorch so many threads from now on."""
    torch.set_num_threads(threads)


def product_type(precision: Precision) -> torch.dtype:
    """In what the networks' products are computed here; "auto" is bfloat16 where the processor has it."""
    if precision == "auto":
        able = torch.cpu.get_capabilities()
        precision = "bfloat16" if able.get("avx512_bf16") or able.get("amx_bf16") else "float32"
    return torch.bfloat16 if precision == "bfloat16" else torch.float32
