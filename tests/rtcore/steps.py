"""Steps of a made-up world, for tests of what reads them."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtcore.messages import Step


def floats(*values: float) -> bytes:
    return np.array(values, "<f4").tobytes()


def make_step(seq: int, *, incarnation: int = 1, episode_steps: int = 4, **fields: Any) -> Step:
    """Step `seq` of a world whose episodes have `episode_steps` ticks after the reset tick. The
    observation is (seq, incarnation), the decision -seq, the reward seq / 2."""
    episode, episode_tick = divmod(seq, episode_steps + 1)
    plain: dict[str, Any] = {
        "env": "env0",
        "incarnation": incarnation,
        "seq": seq,
        "tick": seq + 100,
        "episode": episode,
        "episode_tick": episode_tick,
        "unit": seq // 3,
        "due_ns": 0,
        "woke_ns": 0,
        "sent_ns": 0,
        "observation": floats(seq, incarnation),
        "reward": seq / 2 if episode_tick else 0.0,
        "terminated": False,
        "truncated": episode_tick == episode_steps,
        "action": floats(-1000 - seq) if episode_tick else b"",
        "decision": floats(-seq) if episode_tick else b"",
        "answered_tick": -1,
        "policy_version": 0,
        "missed": False,
        "fallback": "",
        "cause": "",
        "skipped": 0,
        "loop_ns": -1,
        "reaction_ns": -1,
        "drift": 0.0,
        "position": b"",
    }
    return Step(**(plain | fields))
