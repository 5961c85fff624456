from __future__ import annotations

import numpy as np
import pytest
import torch

from learner.deep.reward_families import Declared, Latents, nearest_target
from learner.deep.reward_net import Learned
from learner.replay import Replay
from rtcore.config import RewardModelConfig
from tests.learner import formulas
from tests.learner.rewards import FAMILY, SPACES, SPEED, Stage


def test_the_nearest_target_by_hand() -> None:
    # Seen from 0 it is 0.25 away, from 1 it is 0.75 away.
    assert nearest_target(np.array([0.0, 1.0]), np.array([0.25, 0.75])) == pytest.approx((0.25, 0.0))
    # 2 away from 0 is 2 or -2; 1 away from 1 tells which.
    assert nearest_target(np.array([0.0, 1.0, 0.0]), np.array([2.0, 1.0, 2.0]))[0] == pytest.approx(2.0)
    # Contradiction: 1 and 3 away from 0. 2 or -2 miss both by 1; of equals the lower.
    assert nearest_target(np.array([0.0, 0.0]), np.array([1.0, 3.0])) == (-2.0, 1.0)
    # Closer than possible: nothing is -1 away. The least error is at the point itself.
    assert nearest_target(np.array([0.5]), np.array([-1.0])) == (0.5, 1.0)


def test_the_nearest_target_is_the_best_of_a_fine_grid() -> None:
    rng = np.random.default_rng(0)
    grid = np.linspace(-6, 6, 24_001)
    for n in (1, 2, 5, 40):
        speed, distance = rng.standard_normal(n), rng.normal(0.5, 1.0, n)
        totals = ((abs(speed - grid[:, None]) - distance) ** 2).mean(1)
        z, error = nearest_target(speed, distance)
        assert error == pytest.approx(((abs(speed - z) - distance) ** 2).mean(), abs=1e-9)
        assert error <= totals.min() + 1e-9
        assert error == pytest.approx(totals.min(), abs=1e-3)


def test_the_declared_family_by_hand() -> None:
    """|2 * 1.5 - 1| = 2; actions 0.5 and -1 are 2 + 4 * 0.5 = 4 and -1: 0.1 * 17 = 1.7; 3 - 2 - 1.7."""
    stage = Stage()
    following, action = np.array([9.0, 1.5, 9.0], np.float32), np.array([0.5, -1.0], np.float32)
    stage.replay.add(following, action, -0.7, following, False, 0)
    family = Declared(RewardModelConfig(speed_entry=SPEED), FAMILY, SPACES)
    seen = stage.replay.read(0, 1)
    assert family.rewards(seen, 1.0).tolist() == pytest.approx([-0.7])  # type: ignore[arg-type]
    family.begin(0)
    family.fit(seen)
    assert family.series(0).tolist() == pytest.approx([1.0])  # 1 or 5: of equals the lower
    assert family.residual == pytest.approx(0.0, abs=1e-3)


def test_the_latents_of_units_without_transitions_repeat_the_one_before() -> None:
    latents = Latents(keep=4)
    assert latents.series(3).tolist() == []
    latents.begin(3)
    latents.values[-1] = 7.0
    latents.begin(5)
    assert latents.series(5).tolist() == [7.0, 7.0, 7.0]
    assert (latents.series(3).tolist(), latents.series(2).tolist()) == ([7.0], [])
    latents.begin(8)
    assert (latents.first, latents.newest) == (5, 8)


def test_a_step_of_the_learned_family_descends_on_its_loss() -> None:
    stage = Stage()
    for unit in range(5):
        stage.live(unit, 1.0)
    family = Learned(RewardModelConfig(), stage.replay, 32, np.random.default_rng(5))
    for unit in range(5):
        family.begin(unit)
    family._latents.values[:] = np.linspace(-1, 1, 5)
    views = family._parameters.views(family._parameters.flat)
    leaves = {name: view.clone().requires_grad_() for name, view in views.items()}
    latents = torch.linspace(-1, 1, 5).requires_grad_()
    family._step()
    halves = family._halves
    assert halves[0].unit.min() == 0
    assert halves[1].unit.min() == 2  # the last three units
    following, action, reward = (
        torch.from_numpy(np.concatenate([getattr(half, name) for half in halves]))
        for name in ("next_observation", "action", "reward")
    )
    z = latents[torch.from_numpy(np.concatenate([half.unit for half in halves])).long()]
    paid = formulas.mlp(leaves, torch.cat([following, action, z[:, None]], 1))[0, :, 0]
    loss = (paid - reward).square().mean() + 1e-3 * z.square().mean()
    loss.backward()  # type: ignore[no-untyped-call]
    for name, gradient in family._parameters.views(family._parameters.grad).items():
        torch.testing.assert_close(gradient, leaves[name].grad, rtol=1e-4, atol=1e-5)
    assert latents.grad is not None
    slope = latents.grad.numpy()  # Adam's first step goes as far as the rate, whatever the slope
    np.testing.assert_allclose(family._moments[0], 0.1 * slope, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(
        family._latents.values, np.linspace(-1, 1, 5) - 2e-2 * np.sign(slope), atol=1e-4
    )


def by_hand(replay: Replay, weights: list[list[float]]) -> Learned:
    """A network with two hidden units whose outputs are added up: rows of `weights` are s'_0, s'_1, a, z."""
    family = Learned(RewardModelConfig(hidden=(2,)), replay, 8, np.random.default_rng(0))
    views = family._parameters.views(family._parameters.flat)
    family._parameters.flat.zero_()
    views["0.weight"][0] = torch.tensor(weights)
    views["1.weight"][0] = 1.0
    family._net.refresh()
    return family


@pytest.mark.parametrize("target", [0.4, -0.4])
def test_a_latent_is_fitted_with_the_network_as_it_is(target: float) -> None:
    """f = |s'_1 - z| as relu(s'_1 - z) + relu(z - s'_1)."""
    replay, rng = Replay(100, 2, 1), np.random.default_rng(0)
    for _ in range(20):
        following = rng.standard_normal(2, np.float32)
        replay.add(following, np.zeros(1, np.float32), float(abs(following[1] - target)), following, False, 0)
    family = by_hand(replay, [[0.0, 0.0], [1.0, -1.0], [0.0, 0.0], [-1.0, 1.0]])
    family.begin(0)
    family.fit(replay.read(0, 20))
    # (z - target)^2 where no speed lies between, + 1e-3 z^2 + 1e-2 (z - 0)^2: at target / 1.011
    assert family.series(0).tolist() == pytest.approx([target / 1.011], abs=1e-3)
    assert family.residual == pytest.approx(abs(target) * 0.011 / 1.011, abs=1e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_of_latents_that_pay_the_same_the_nearer_to_the_unit_before_is_taken(side: float) -> None:
    """f = |z|, and everything pays 0.3."""
    replay = Replay(100, 2, 1)
    for unit in (0, 1):
        replay.add(
            np.zeros(2, np.float32), np.zeros(1, np.float32), 0.3, np.zeros(2, np.float32), False, unit
        )
    family = by_hand(replay, [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [1.0, -1.0]])
    family.begin(0)
    family._latents.values[-1] = 0.2 * side
    family.begin(1)
    family.fit(replay.read(1, 1))
    # (z - 0.3)^2 + 1e-3 z^2 + 1e-2 (z - 0.2)^2: at (0.3 + 0.002) / 1.011
    assert family.series(1)[-1] == pytest.approx(side * 0.302 / 1.011, abs=1e-3)
