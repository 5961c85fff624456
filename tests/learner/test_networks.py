from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from learner.deep.networks import (
    Adam,
    FlatParameters,
    make_actor,
    make_networks,
    make_twin_critic,
    policy_arrays,
)
from rtcore.messages import Architecture
from rtcore.weights import expected_shapes
from tests.learner.formulas import mlp

OBSERVATION, ACTION, HIDDEN = 3, 2, (8, 5)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_flat_buffer_and_its_views_are_one_memory() -> None:
    parameters = FlatParameters({"a": (2, 3), "b": (1,)})
    assert parameters.flat.shape == parameters.grad.shape == (32,)  # both on 64 bytes
    parameters.flat[16] = 7.0
    views = parameters.views(parameters.flat)
    assert views["b"].item() == 7.0
    assert all(view.data_ptr() % 64 == 0 for view in views.values())


def test_a_frozen_copy_has_memory_of_its_own_and_no_gradient() -> None:
    parameters = FlatParameters({"a": (2, 3)})
    copy = parameters.frozen_copy()
    parameters.flat.fill_(1.0)
    assert copy.flat.tolist() == [0.0] * 16
    assert copy.grad.shape == (0,)


def test_adam_agrees_with_torch() -> None:
    ours, grad = torch.linspace(-1, 1, 8), torch.empty(8)
    theirs = ours.clone().requires_grad_()
    reference = torch.optim.Adam([theirs], lr=0.01)
    adam = Adam(ours, grad, 0.01)
    for step in range(5):
        grad.copy_(torch.sin(ours + step))
        theirs.grad = grad.clone()
        adam.step()
        reference.step()
    torch.testing.assert_close(ours, theirs.detach())
    assert adam.steps.item() == 5


def test_initial_weights_are_those_of_a_linear_layer() -> None:
    networks = make_networks(2, [7, 400, 30], rng())
    for name in ("1.weight", "1.bias"):
        values = networks.views(networks.flat)[name]
        bound = 1 / 400**0.5
        assert values.abs().max() <= bound
        assert values.std().item() == pytest.approx(bound / 3**0.5, rel=0.2 if "bias" in name else 0.05)


def test_the_published_policy_is_the_actor() -> None:
    actor = make_actor(OBSERVATION, ACTION, HIDDEN, rng())
    arrays = policy_arrays(actor, ACTION)
    shape = Architecture(
        kind="tanh_gaussian_mlp", observation_dim=OBSERVATION, action_dim=ACTION, hidden=list(HIDDEN)
    )
    assert {name: array.shape for name, array in arrays.items()} == expected_shapes(shape)
    assert all(array.dtype == np.float32 and array.flags.c_contiguous for array in arrays.values())
    observation = torch.randn(7, OBSERVATION)
    heads = mlp(actor.views(actor.flat), observation)[0].numpy()
    hidden = observation.numpy()
    for layer in ("trunk.0", "trunk.1"):
        hidden = np.maximum(hidden @ arrays[f"{layer}.weight"].T + arrays[f"{layer}.bias"], 0)
    for head, wanted in (("mean", heads[:, :ACTION]), ("log_std", heads[:, ACTION:])):
        found = hidden @ arrays[f"{head}.weight"].T + arrays[f"{head}.bias"]
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-6)


def test_published_arrays_are_copies() -> None:
    actor = make_actor(OBSERVATION, ACTION, HIDDEN, rng())
    before = policy_arrays(actor, ACTION)["mean.bias"].copy()
    arrays = policy_arrays(actor, ACTION)
    actor.flat.add_(1.0)
    np.testing.assert_array_equal(arrays["mean.bias"], before)


def test_twin_critics_are_two_plain_networks() -> None:
    critic = make_twin_critic(OBSERVATION, ACTION, HIDDEN, rng())
    views = critic.views(critic.flat)
    inputs = torch.randn(6, OBSERVATION + ACTION)
    both = mlp(views, inputs)
    assert both.shape == (2, 6, 1)
    for twin in range(2):
        layers = [nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 5), nn.ReLU(), nn.Linear(5, 1)]
        for index, linear in enumerate(layer for layer in layers if isinstance(layer, nn.Linear)):
            linear.weight.data = views[f"{index}.weight"][twin].T
            linear.bias.data = views[f"{index}.bias"][twin, 0]
        torch.testing.assert_close(both[twin], nn.Sequential(*layers)(inputs).detach())
    assert not torch.equal(both[0], both[1])
