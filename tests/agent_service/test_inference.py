"""The agent's network against the written formula."""

from __future__ import annotations

import numpy as np

from agent_service.inference import TanhGaussianPolicy, UniformPolicy
from rtcore.messages import Architecture

LOW, HIGH = np.array([-2, 0], np.float32), np.array([2, 1], np.float32)


def weights(rng: np.random.Generator, hidden: list[int]) -> dict[str, np.ndarray]:
    sizes = [3, *hidden]
    found = {}
    for i, (fan_in, fan_out) in enumerate(zip(sizes, hidden, strict=False)):
        found[f"trunk.{i}.weight"] = rng.normal(size=(fan_out, fan_in)).astype(np.float32)
        found[f"trunk.{i}.bias"] = rng.normal(size=fan_out).astype(np.float32)
    for head in ("mean", "log_std"):
        found[f"{head}.weight"] = rng.normal(size=(2, hidden[-1])).astype(np.float32)
        found[f"{head}.bias"] = rng.normal(size=2).astype(np.float32)
    return found


def test_an_action_by_hand() -> None:
    """One hidden unit: h = relu(1*2 - 1) = 1; mean = 0.5, 0; std = e^0 = 1."""
    w = {
        "trunk.0.weight": np.array([[1, 0, 0]], np.float32),
        "trunk.0.bias": np.array([-1], np.float32),
        "mean.weight": np.array([[0.5], [0]], np.float32),
        "mean.bias": np.zeros(2, np.float32),
        "log_std.weight": np.zeros((2, 1), np.float32),
        "log_std.bias": np.array([0, -100], np.float32),  # clamped to -20: no noise left
    }
    architecture = Architecture(kind="tanh_gaussian_mlp", observation_dim=3, action_dim=2, hidden=[1])
    policy = TanhGaussianPolicy(1, architecture, w, LOW, HIGH)
    noise = np.random.default_rng(5).standard_normal(2, dtype=np.float32)
    action = policy.act(np.array([2, 7, 7], np.float32), np.random.default_rng(5))
    np.testing.assert_allclose(action, [2 * np.tanh(0.5 + noise[0]), 0.5], rtol=1e-6)


def test_it_equals_the_plain_formula_for_two_layers() -> None:
    rng = np.random.default_rng(0)
    w = weights(rng, [8, 5])
    architecture = Architecture(kind="tanh_gaussian_mlp", observation_dim=3, action_dim=2, hidden=[8, 5])
    policy = TanhGaussianPolicy(1, architecture, w, LOW, HIGH)
    policy.warm_up()
    acting, drawing = np.random.default_rng(9), np.random.default_rng(9)
    for _ in range(150):  # the noise is drawn for 64 actions at once, and is the same
        observation = rng.normal(size=3).astype(np.float32)
        h = np.maximum(w["trunk.0.weight"] @ observation + w["trunk.0.bias"], 0)
        h = np.maximum(w["trunk.1.weight"] @ h + w["trunk.1.bias"], 0)
        mean = w["mean.weight"] @ h + w["mean.bias"]
        std = np.exp(np.clip(w["log_std.weight"] @ h + w["log_std.bias"], -20, 2))
        noise = drawing.standard_normal(2, dtype=np.float32)
        wanted = (HIGH + LOW) / 2 + (HIGH - LOW) / 2 * np.tanh(mean + std * noise)
        np.testing.assert_allclose(policy.act(observation, acting), wanted, rtol=2e-5, atol=1e-6)


def test_pi_0_fills_the_action_space_evenly_and_repeats_with_its_seed() -> None:
    policy = UniformPolicy(LOW, HIGH)
    rng = np.random.default_rng(1)
    drawn = np.array([policy.act(np.zeros(3, np.float32), rng).copy() for _ in range(4000)])
    assert (drawn >= LOW).all() and (drawn <= HIGH).all()
    np.testing.assert_allclose(drawn.mean(0), (LOW + HIGH) / 2, atol=0.05)
    np.testing.assert_allclose(drawn.var(0), (HIGH - LOW) ** 2 / 12, rtol=0.06)
    again = UniformPolicy(LOW, HIGH).act(np.zeros(3, np.float32), np.random.default_rng(1))
    np.testing.assert_array_equal(again, drawn[0])
