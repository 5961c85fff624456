from __future__ import annotations

import numpy as np
import pytest
import torch

from learner.checkpoint import CheckpointError
from learner.deep.fsac import Fsac
from learner.deep.sac import Sac
from learner.deep.value_network import ValueNetwork
from rtcore.config import LearnerConfig
from rtcore.windows import Window
from tests.learner import formulas
from tests.learner.plain_sac import PlainValueSac, linears
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, forq, small_config


def make(config: LearnerConfig | None = None, seed: int = 3) -> Sac:
    config = config or small_config(value_network=True)
    return (Fsac if config.algo == "fsac" else Sac)(
        config, OBSERVATION_DIM, ACTION_DIM, seed, filled_replay()
    )


def train(student: Sac, updates: int, *, improve_policy: bool = True) -> None:
    for _ in range(updates):
        student.update(improve_policy=improve_policy)


def test_it_is_plain_sac_with_a_value_network() -> None:
    config = small_config(
        value_network=True, actor_lr=1e-2, critic_lr=2e-2, alpha_lr=3e-2, tau=0.05, gamma=0.9
    )
    sac = make(config)
    plain = PlainValueSac(config, sac.state(), filled_replay())
    for improve in (True, False, True, True, True):
        sac.update(improve_policy=improve)
        plain.update(improve_policy=improve)
        seen = sac.metrics()
        assert {name: seen[name] for name in plain.losses} == pytest.approx(plain.losses, rel=1e-4, abs=1e-5)
    tensors = sac.state().tensors
    trained = {
        "actor": [plain.actor],
        "critic": plain.critics,
        "value": [plain.value],
        "value_target": [plain.value_target],
    }
    for name, models in trained.items():
        for twin, model in enumerate(models):
            for layer, linear in enumerate(linears(model)):
                for kind, wanted in (("weight", linear.weight.T), ("bias", linear.bias)):
                    found = tensors[f"{name}.{layer}.{kind}"][twin].reshape(wanted.shape)
                    np.testing.assert_allclose(found, wanted.detach().numpy(), rtol=1e-3, atol=1e-5)
    assert sac.metrics()["alpha"] == pytest.approx(plain.log_alpha.exp().item(), rel=1e-5)


def test_the_slow_copy_by_hand() -> None:
    # no hidden unit speaks, so V is its last bias: 0. Adam's first step is its learning rate, up: 0.5
    network = ValueNetwork([2, 4, 1], 3, np.random.default_rng(0), 0.5, torch.float32)
    for parameters in (network.parameters, network.target):
        parameters.flat.zero_()
    network.refresh()
    network.learn(torch.ones(3, 2), torch.full((3,), 6.0))
    assert network.metrics() == {"loss/value": 18.0}  # 1/2 (0 - 6)^2
    assert network.bootstrap(torch.ones(3, 2)).tolist() == [0.0] * 3
    network.follow(0.25)
    assert network.bootstrap(torch.ones(3, 2)).tolist() == pytest.approx([0.125] * 3)


def test_the_loss_descends_as_autograd_does() -> None:
    network = ValueNetwork([2, 4, 1], 3, np.random.default_rng(0), 0.5, torch.float32)
    leaves = {
        name: view.clone().requires_grad_()
        for name, view in network.parameters.views(network.parameters.flat).items()
    }
    observation, soft_value = (
        torch.tensor([[1.0, 2.0], [-1.0, 0.5], [0.0, 3.0]]),
        torch.tensor([1.0, -2.0, 0.5]),
    )
    loss = 0.5 * (formulas.mlp(leaves, observation)[0, :, 0] - soft_value).square().mean()
    network.learn(observation, soft_value)
    assert network.metrics()["loss/value"] == pytest.approx(loss.item(), rel=1e-6)
    wanted = torch.autograd.grad(loss, list(leaves.values()))
    found = network.parameters.views(network.parameters.grad)
    for gradient, of_autograd in zip(found.values(), wanted, strict=True):
        torch.testing.assert_close(gradient, of_autograd)


def test_a_paused_policy_keeps_every_bit() -> None:
    sac = make()
    train(sac, 5)
    before = sac.state()
    train(sac, 5, improve_policy=False)
    for name, value in sac.state().tensors.items():
        still = name.startswith(("actor.", "temperature."))
        assert (before.tensors[name].tobytes() == value.tobytes()) is still, name
    assert (sac.gradient_steps, sac.policy_steps) == (10, 5)


@pytest.mark.parametrize("algo", ["sac", "fsac"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_it_outlives_the_process(algo: str, precision: str) -> None:
    config = small_config(value_network=True, algo=algo, precision=precision)
    before, after = make(config), make(config, seed=8)
    train(before, 5)
    after.load(before.state())
    assert "loss/value" not in after.metrics()
    for student in (before, after):
        train(student, 5)
    for name, value in before.state().tensors.items():
        assert after.state().tensors[name].tobytes() == value.tobytes(), name


def test_a_checkpoint_with_target_critics_does_not_fit() -> None:
    plain, valued = make(small_config()), make()
    with pytest.raises(CheckpointError, match=r"value\.0\.bias missing"):
        valued.load(plain.state())
    with pytest.raises(CheckpointError, match=r"value\.0\.bias unknown"):
        plain.load(valued.state())


def test_the_forecast_is_in_the_policy_loss_alone() -> None:
    sac, fsac = make(), make(small_config(value_network=True, algo="fsac", forecast=forq()))
    for student in (sac, fsac):
        for unit in range(4):
            train(student, 3)
            student.end_unit(unit)
        student.begin_window(Window(m=1, start=4, update=3, hold=1), 4)
        train(student, 1)
    assert fsac.metrics()["forecast/snapshots"] == 3
    plain, forecast = sac.state().tensors, fsac.state().tensors
    for name, value in plain.items():
        other = name.startswith("actor.") and not name.endswith("steps")
        assert (forecast[name].tobytes() != value.tobytes()) is other, name
