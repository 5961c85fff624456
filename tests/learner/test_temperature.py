from __future__ import annotations

import pytest
import torch

from learner.deep.temperature import Temperature


def test_it_descends_on_its_loss() -> None:
    # J = -log(alpha) mean(log pi + target) = -log(alpha) (-2 - 1): the gradient in log(alpha) is 3
    temperature = Temperature("auto", 0.1, -1.0)
    assert (temperature.value, temperature.loss(2.0)) == (1.0, None)
    temperature.step(torch.tensor([-1.0, -3.0]))
    assert temperature.parameters.grad[0] == 3.0
    assert temperature.value == pytest.approx(2.718281828**-0.1)  # Adam's first step is its learning rate
    assert temperature.loss(2.0) == 0.0  # of the step before, from log(alpha) = 0
    temperature.step(torch.tensor([-1.0, -3.0]))
    assert temperature.loss(2.0) == pytest.approx(-0.3)  # -(-0.1) (-3)
    temperature.forget()
    assert temperature.loss(2.0) is None


def test_a_fixed_one_stays() -> None:
    temperature = Temperature(0.2, 0.1, -1.0)
    temperature.step(torch.tensor([-1.0]))
    assert (temperature.value, temperature.loss(2.0)) == (0.2, None)
