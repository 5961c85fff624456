from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from learner.networks import (
    Adam,
    FlatParameters,
    make_actor,
    make_twin_critic,
    min_q,
    policy_arrays,
    policy_heads,
    squashed_gaussian,
    twin_q,
)
from rtcore.messages import Architecture
from rtcore.weights import expected_shapes

OBSERVATION, ACTION, HIDDEN = 3, 2, (8, 5)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_the_flat_buffer_and_its_views_are_one_memory() -> None:
    parameters = FlatParameters({"a": (2, 3), "b": (1,)})
    assert parameters.flat.shape == (32,)  # both on 64 bytes
    parameters.flat[16] = 7.0
    assert parameters.frozen[1].item() == 7.0
    assert parameters.leaves[1].item() == 7.0
    assert all(leaf.data_ptr() % 64 == 0 for leaf in parameters.leaves)


def test_gradients_gather_in_the_flat_buffer() -> None:
    parameters = FlatParameters({"a": (2,), "b": (1,)})
    loss = 3.0 * parameters.leaves[0].sum() - parameters.leaves[1].sum()
    torch.autograd.backward(loss)
    wanted = torch.zeros(32)
    wanted[0:2], wanted[16] = 3.0, -1.0
    torch.testing.assert_close(parameters.grad, wanted)


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
    actor = make_actor(OBSERVATION, ACTION, (400,), rng())
    weight = actor.views(actor.flat)["heads.weight"]
    bound = 1 / 400**0.5
    assert weight.abs().max() <= bound
    assert weight.std().item() == pytest.approx(bound / 3**0.5, rel=0.05)


def test_the_published_policy_is_the_actor() -> None:
    actor = make_actor(OBSERVATION, ACTION, HIDDEN, rng())
    arrays = policy_arrays(actor, ACTION)
    shape = Architecture(
        kind="tanh_gaussian_mlp", observation_dim=OBSERVATION, action_dim=ACTION, hidden=list(HIDDEN)
    )
    assert {name: array.shape for name, array in arrays.items()} == expected_shapes(shape)
    assert all(array.dtype == np.float32 for array in arrays.values())
    observation = torch.randn(7, OBSERVATION)
    mean, log_std = policy_heads(actor.frozen, observation)
    hidden = observation.numpy()
    for layer in ("trunk.0", "trunk.1"):
        hidden = np.maximum(hidden @ arrays[f"{layer}.weight"].T + arrays[f"{layer}.bias"], 0)
    np.testing.assert_allclose(
        mean, hidden @ arrays["mean.weight"].T + arrays["mean.bias"], rtol=1e-4, atol=1e-6
    )
    np.testing.assert_allclose(
        log_std, hidden @ arrays["log_std.weight"].T + arrays["log_std.bias"], rtol=1e-4, atol=1e-6
    )


def test_published_arrays_are_copies() -> None:
    actor = make_actor(OBSERVATION, ACTION, HIDDEN, rng())
    before = policy_arrays(actor, ACTION)["mean.bias"].copy()
    arrays = policy_arrays(actor, ACTION)
    actor.flat.add_(1.0)
    np.testing.assert_array_equal(arrays["mean.bias"], before)


def test_log_std_is_clamped() -> None:
    actor = make_actor(OBSERVATION, ACTION, HIDDEN, rng())
    bias = actor.views(actor.flat)["heads.bias"]
    bias[ACTION:] = torch.tensor([100.0, -100.0])
    _, log_std = policy_heads(actor.frozen, torch.zeros(1, OBSERVATION))
    assert log_std.tolist() == [[2.0, -20.0]]


def test_the_log_density_by_hand() -> None:
    # mean 0.3, std 0.5, noise 0.8: u = 0.7; log N = -0.32 + 0.69315 - 0.91894 = -0.54579;
    # log(1 - tanh(0.7)^2) = log(1 - 0.60437^2) = -0.45454; difference -0.09125
    half = torch.tensor([[0.5]]).log()
    action, log_prob = squashed_gaussian(torch.tensor([[0.3]]), half, torch.tensor([[0.8]]))
    assert action.item() == pytest.approx(0.60437, abs=1e-5)
    assert log_prob.item() == pytest.approx(-0.09125, abs=1e-5)


def test_the_log_density_agrees_with_the_plain_formula() -> None:
    mean, log_std, noise = torch.randn(50, 3, dtype=torch.float64).unbind(1)
    mean, log_std, noise = (x[:, None] for x in (mean, log_std, noise))
    action, log_prob = squashed_gaussian(mean, log_std, noise)
    u = mean + log_std.exp() * noise
    log_normal = torch.log(torch.exp(-(noise**2) / 2) / (log_std.exp() * (2 * torch.pi) ** 0.5))
    density = log_normal - torch.log(1 - torch.tanh(u) ** 2)
    keep = u[:, 0].abs() < 8  # beyond, the plain formula itself breaks down
    torch.testing.assert_close(log_prob[keep], density.sum(1)[keep])
    torch.testing.assert_close(action, torch.tanh(u))


def test_the_log_density_stays_finite_where_tanh_saturates() -> None:
    mean = torch.tensor([[40.0]], requires_grad=True)
    _, log_prob = squashed_gaussian(mean, torch.zeros(1, 1), torch.zeros(1, 1))
    torch.autograd.backward(log_prob.sum())
    # log(1 - tanh(u)^2) -> 2 log 2 - 2u, so its share of the gradient is +2
    assert log_prob.item() == pytest.approx(-0.918939 - 2 * 0.693147 + 80, abs=1e-4)
    assert mean.grad is not None
    assert mean.grad.item() == pytest.approx(2.0)


def test_twin_critics_are_two_plain_networks() -> None:
    critic = make_twin_critic(OBSERVATION, ACTION, HIDDEN, rng())
    observation, action = torch.randn(6, OBSERVATION), torch.randn(6, ACTION)
    both = twin_q(critic.frozen, observation, action)
    assert both.shape == (2, 6)
    views = critic.views(critic.flat)
    for twin in range(2):
        layers = [nn.Linear(5, 8), nn.ReLU(), nn.Linear(8, 5), nn.ReLU(), nn.Linear(5, 1)]
        for index in range(3):
            layer = layers[2 * index]
            assert isinstance(layer, nn.Linear)
            weight = views[f"{index}.weight"][twin]
            layer.weight.data = weight if index == 2 else weight.T
            layer.bias.data = views[f"{index}.bias"][twin].view(-1)
        wanted = nn.Sequential(*layers)(torch.cat((observation, action), 1))[:, 0].detach()
        torch.testing.assert_close(both[twin], wanted)
    torch.testing.assert_close(min_q(critic.frozen, observation, action), both.amin(0))
    assert not torch.equal(both[0], both[1])


def test_frozen_parameters_let_gradients_through_to_the_action_only() -> None:
    critic = make_twin_critic(OBSERVATION, ACTION, HIDDEN, rng())
    action = torch.randn(6, ACTION, requires_grad=True)
    torch.autograd.backward(min_q(critic.frozen, torch.randn(6, OBSERVATION), action).sum())
    assert action.grad is not None and action.grad.abs().sum() > 0
    assert critic.grad.abs().sum() == 0
