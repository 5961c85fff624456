from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from learner.deep.gradients import (
    Mlp,
    Pass,
    climb,
    critic_loss_to_output,
    policy_loss_to_heads,
    propose,
    smaller,
)
from learner.deep.networks import FlatParameters, make_networks
from tests.learner import formulas

ROWS, ACTION = 12, 2
TYPES = [torch.float32, torch.bfloat16]
HIDDEN = [(9,), (8, 5), (8, 16, 5)]


def made(nets: int, widths: list[int], precision: torch.dtype) -> tuple[FlatParameters, Mlp, Pass]:
    """Networks, and a pass that holds a batch for them."""
    parameters = make_networks(nets, widths, np.random.default_rng(0))
    room = Pass(nets, ROWS, widths, precision)
    room.input.copy_(torch.randn(ROWS, widths[0], generator=torch.Generator().manual_seed(1)))
    return parameters, Mlp(parameters, precision), room


def leaves(parameters: FlatParameters) -> dict[str, Tensor]:
    """The parameters, for autograd."""
    views = parameters.views(parameters.flat)
    return {name: view.clone().requires_grad_() for name, view in views.items()}


def assert_close(found: Tensor, wanted: Tensor, precision: torch.dtype) -> None:
    """Equal within rounding: 2^-24 in float32; 2^-9 in bfloat16, and there a ReLU near zero may flip."""
    assert found.shape == wanted.shape
    limit = 1e-5 if precision == torch.float32 else 0.15
    assert (found - wanted).norm() <= limit * wanted.norm()


@pytest.mark.parametrize("precision", TYPES)
@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("nets", [1, 2])
def test_values_are_those_of_the_formula(nets: int, hidden: tuple[int, ...], precision: torch.dtype) -> None:
    parameters, net, room = made(nets, [4, *hidden, 3], precision)
    wanted = formulas.mlp(parameters.views(parameters.flat), room.input.float())
    found = room.forward(net)
    assert found.dtype == torch.float32
    assert_close(found, wanted, precision)


@pytest.mark.parametrize("precision", TYPES)
@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("nets", [1, 2])
def test_gradients_in_parameters_and_input_are_those_of_autograd(
    nets: int, hidden: tuple[int, ...], precision: torch.dtype
) -> None:
    parameters, net, room = made(nets, [4, *hidden, 3], precision)
    plain, inputs = leaves(parameters), room.input.float().clone().requires_grad_()
    d_output = torch.randn(nets, ROWS, 3, generator=torch.Generator().manual_seed(2))
    torch.autograd.backward(formulas.mlp(plain, inputs), d_output)
    room.forward(net)
    room.to_parameters(net, d_output)
    for name, found in parameters.views(parameters.grad).items():
        wanted = plain[name].grad
        assert wanted is not None
        assert_close(found, wanted, precision)
    assert inputs.grad is not None
    found = room.to_input(net, d_output, 2).float().sum(0)
    assert_close(found, inputs.grad[:, -2:], precision)


@pytest.mark.parametrize("precision", TYPES)
def test_new_parameters_count_from_the_next_refresh(precision: torch.dtype) -> None:
    parameters, net, room = made(2, [4, 8, 1], precision)
    before = room.forward(net).clone()
    parameters.flat.mul_(2.0)
    net.refresh()
    wanted = formulas.mlp(parameters.views(parameters.flat), room.input.float())
    assert_close(room.forward(net), wanted, precision)
    assert not torch.equal(room.output, before)


@pytest.mark.parametrize("precision", TYPES)
def test_some_rows_are_a_pass_of_their_own(precision: torch.dtype) -> None:
    parameters, net, room = made(1, [4, 8, 3], precision)
    whole = room.forward(net)[:, 4:10].clone()
    room.output.zero_()
    part = room.rows(4, 10)
    torch.testing.assert_close(part.forward(net), whole)
    torch.testing.assert_close(room.output[:, 4:10], whole)
    assert room.output[:, :4].abs().sum() == 0
    plain = leaves(parameters)
    torch.autograd.backward(formulas.mlp(plain, part.input.float()), torch.ones(1, 6, 3))
    part.to_parameters(net, torch.ones(1, 6, 3))
    wanted = plain["0.weight"].grad
    assert wanted is not None
    assert_close(parameters.views(parameters.grad)["0.weight"], wanted, precision)


def test_an_output_is_not_rounded() -> None:
    """150.25 in bfloat16 would be 150."""
    parameters, net, room = made(2, [4, 8, 1], torch.bfloat16)
    parameters.flat.zero_()
    parameters.views(parameters.flat)["1.bias"].fill_(150.25)
    net.refresh()
    assert room.forward(net).flatten().tolist() == [150.25] * 2 * ROWS


@pytest.mark.parametrize("precision", TYPES)
def test_climbing_goes_up_the_smaller_critic(precision: torch.dtype) -> None:
    parameters, net, room = made(2, [5, 16, 16, 1], precision)
    inputs = room.input.float().clone().requires_grad_()
    wanted = formulas.mlp(parameters.views(parameters.flat), inputs)[..., 0].min(0).values
    torch.autograd.backward(wanted.sum())
    value, slope = climb(room, net, ACTION)
    assert inputs.grad is not None
    assert_close(value, wanted.detach(), precision)
    assert_close(slope, inputs.grad[:, -ACTION:], precision)
    assert torch.equal(value, smaller(room.output))


def test_the_log_density_by_hand() -> None:
    # mean 0.3, std 0.5, noise 0.8: u = 0.7; log N = -0.32 + 0.69315 - 0.91894 = -0.54579;
    # log(1 - tanh(0.7)^2) = log(1 - 0.60437^2) = -0.45454; difference -0.09125
    drawn = propose(torch.tensor([[0.3, np.log(0.5)]]), torch.tensor([[0.8]]))
    assert drawn.action.item() == pytest.approx(0.60437, abs=1e-5)
    assert drawn.log_prob.item() == pytest.approx(-0.09125, abs=1e-5)


def test_the_log_density_stays_finite_where_tanh_saturates() -> None:
    # log(1 - tanh(u)^2) -> 2 log 2 - 2u
    drawn = propose(torch.tensor([[40.0, 0.0]]), torch.zeros(1, 1))
    assert drawn.log_prob.item() == pytest.approx(-0.918939 - 2 * 0.693147 + 80, abs=1e-4)


def test_log_std_is_clamped() -> None:
    drawn = propose(torch.tensor([[0.0, 0.0, 100.0, -100.0]]), torch.ones(1, 2))
    assert drawn.spread.tolist() == [[pytest.approx(np.exp(2.0)), pytest.approx(np.exp(-20.0))]]
    assert drawn.free.tolist() == [[0.0, 0.0]]


def test_the_policy_loss_descends_as_autograd_does() -> None:
    generator = torch.Generator().manual_seed(3)
    heads = torch.randn(ROWS, 2 * ACTION, generator=generator)
    heads[0, ACTION], heads[1, ACTION] = 2.5, -21.0  # clamped: no gradient in these
    noise = torch.randn(ROWS, ACTION, generator=generator)
    slope, alpha = torch.randn(ROWS, ACTION, generator=generator), 0.3
    plain = heads.double().requires_grad_()
    action, log_prob = formulas.squashed_gaussian(plain, noise.double())
    torch.autograd.backward((alpha * log_prob - (slope * action).sum(-1)).mean())
    drawn = propose(heads, noise)
    keep = drawn.action.abs().amax(1) < 0.999  # beyond, the plain formula itself breaks down
    torch.testing.assert_close(drawn.log_prob[keep], log_prob.detach().float()[keep])
    assert plain.grad is not None
    found = policy_loss_to_heads(drawn, slope, alpha)
    torch.testing.assert_close(found[keep], plain.grad.float()[keep], rtol=1e-4, atol=1e-6)
    assert found[0, ACTION] == found[1, ACTION] == 0
    assert keep.sum() >= ROWS - 3


def test_the_critic_loss_descends_as_autograd_does() -> None:
    q, target = torch.randn(2, ROWS, 1).requires_grad_(), torch.randn(ROWS)
    torch.autograd.backward(0.5 * (q[..., 0] - target).square().mean(1).sum())
    assert q.grad is not None
    torch.testing.assert_close(critic_loss_to_output(q.detach(), target), q.grad)
