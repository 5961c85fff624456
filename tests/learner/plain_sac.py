"""SAC as the textbook writes it: separate networks, plain autograd, torch's own optimisers."""

from __future__ import annotations

import copy
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learner.checkpoint import State
from learner.replay import Replay, make_batch
from rtcore.config import LearnerConfig
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM


class PlainSac:
    """Starts from the state of a learner before its first update, and takes the same random numbers."""

    def __init__(self, config: LearnerConfig, state: State, replay: Replay) -> None:
        self.config, self.replay, tensors = config, replay, state.tensors
        self.rng = {name: np.random.default_rng() for name in state.scalars["rng"]}
        for name, rng in self.rng.items():
            rng.bit_generator.state = state.scalars["rng"][name]
        widths = [OBSERVATION_DIM, *config.hidden]
        self.actor = network([*widths, 2 * ACTION_DIM])
        load(self.actor, tensors, "actor", 0)
        self.critics = []
        for twin in range(2):
            self.critics.append(network([OBSERVATION_DIM + ACTION_DIM, *config.hidden, 1]))
            load(self.critics[-1], tensors, "critic", twin)
        self.targets = copy.deepcopy(self.critics)
        self.log_alpha = torch.zeros(1, requires_grad=True)
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), lr=config.actor_lr)
        self.critic_adam = torch.optim.Adam(
            [p for critic in self.critics for p in critic.parameters()], lr=config.critic_lr
        )
        self.alpha_adam = torch.optim.Adam([self.log_alpha], lr=config.alpha_lr)
        self.losses: dict[str, float] = {}

    def update(self) -> None:
        config, batch = self.config, make_batch(self.config.batch, OBSERVATION_DIM, ACTION_DIM)
        self.replay.sample(self.rng["batches"], batch)
        s, a, r = (torch.tensor(x) for x in (batch.observation, batch.action, batch.reward))
        s_next, going_on = torch.tensor(batch.next_observation), 1.0 - torch.tensor(batch.terminated).float()
        action, log_prob = self.draw(s)
        alpha = self.alpha()

        if config.alpha == "auto":
            alpha_loss = -(self.log_alpha * (log_prob.detach() - ACTION_DIM)).mean()
            descend(alpha_loss, self.alpha_adam)
            self.losses["loss/alpha"] = alpha_loss.item()

        with torch.no_grad():
            next_action, next_log_prob = self.draw(s_next)
            next_q = torch.minimum(*(q(self.targets, i, s_next, next_action) for i in range(2)))
            target = r + config.gamma * going_on * (next_q - alpha * next_log_prob)
        critic_loss = sum(0.5 * functional.mse_loss(q(self.critics, i, s, a), target) for i in range(2))
        assert isinstance(critic_loss, Tensor)
        descend(critic_loss, self.critic_adam)

        value = torch.minimum(*(q(self.critics, i, s, action) for i in range(2)))
        actor_loss = (alpha * log_prob - value).mean()
        descend(actor_loss, self.actor_adam)

        with torch.no_grad():
            for target_net, critic in zip(self.targets, self.critics, strict=True):
                for old, new in zip(target_net.parameters(), critic.parameters(), strict=True):
                    old.copy_((1 - config.tau) * old + config.tau * new)
        self.losses |= {"loss/critic": critic_loss.item(), "loss/actor": actor_loss.item()}
        self.losses["entropy"] = -log_prob.mean().item()

    def alpha(self) -> Tensor:
        config = self.config
        return self.log_alpha.exp().detach() if config.alpha == "auto" else torch.tensor(config.alpha)

    def draw(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.actor(observation).chunk(2, dim=1)
        std = log_std.clamp(-20, 2).exp()
        noise = torch.tensor(self.rng["noise"].standard_normal(mean.shape, dtype=np.float32))
        u = mean + std * noise
        log_normal = torch.log(torch.exp(-(noise**2) / 2) / (std * (2 * torch.pi) ** 0.5))
        log_prob = log_normal - torch.log(1 - torch.tanh(u) ** 2 + 1e-9)
        return torch.tanh(u), log_prob.sum(1)


class PlainValueSac(PlainSac):
    """The first SAC: a V network, which the critics bootstrap from by way of its slow copy."""

    def __init__(self, config: LearnerConfig, state: State, replay: Replay) -> None:
        super().__init__(config, state, replay)
        self.value = network([OBSERVATION_DIM, *config.hidden, 1])
        load(self.value, state.tensors, "value", 0)
        self.value_target = copy.deepcopy(self.value)
        self.value_adam = torch.optim.Adam(self.value.parameters(), lr=config.critic_lr)

    def update(self, *, improve_policy: bool = True) -> None:
        config, batch = self.config, make_batch(self.config.batch, OBSERVATION_DIM, ACTION_DIM)
        self.replay.sample(self.rng["batches"], batch)
        s, a, r = (torch.tensor(x) for x in (batch.observation, batch.action, batch.reward))
        s_next, going_on = torch.tensor(batch.next_observation), 1.0 - torch.tensor(batch.terminated).float()
        alpha, (action, log_prob) = self.alpha(), self.draw(s)

        if improve_policy:
            alpha_loss = -(self.log_alpha * (log_prob.detach() - ACTION_DIM)).mean()
            descend(alpha_loss, self.alpha_adam)

        with torch.no_grad():
            soft = torch.minimum(*(q(self.critics, i, s, action) for i in range(2))) - alpha * log_prob
        value_loss = 0.5 * functional.mse_loss(self.value(s)[:, 0], soft)
        descend(value_loss, self.value_adam)

        with torch.no_grad():
            target = r + config.gamma * going_on * self.value_target(s_next)[:, 0]
        critic_loss = sum(0.5 * functional.mse_loss(q(self.critics, i, s, a), target) for i in range(2))
        assert isinstance(critic_loss, Tensor)
        descend(critic_loss, self.critic_adam)

        self.losses |= {"loss/critic": critic_loss.item(), "loss/value": value_loss.item()}
        if improve_policy:
            best = torch.minimum(*(q(self.critics, i, s, action) for i in range(2)))
            actor_loss = (alpha * log_prob - best).mean()
            descend(actor_loss, self.actor_adam)
            self.losses["loss/actor"] = actor_loss.item()

        with torch.no_grad():
            for old, new in zip(self.value_target.parameters(), self.value.parameters(), strict=True):
                old.copy_((1 - config.tau) * old + config.tau * new)


def q(critics: list[nn.Sequential], index: int, observation: Tensor, action: Tensor) -> Tensor:
    value: Tensor = critics[index](torch.cat((observation, action), 1))[:, 0]
    return value


def load(model: nn.Sequential, tensors: dict[str, NDArray[np.float32]], name: str, index: int) -> None:
    """Take the parameters of network `index` of those side by side under `name`."""
    for layer, linear in enumerate(linears(model)):
        linear.weight.data = torch.tensor(tensors[f"{name}.{layer}.weight"][index].T.copy())
        linear.bias.data = torch.tensor(tensors[f"{name}.{layer}.bias"][index, 0])


def descend(loss: Tensor, optimiser: torch.optim.Optimizer) -> None:
    optimiser.zero_grad()
    torch.autograd.backward(loss)
    optimiser.step()


def network(widths: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width, out in pairwise(widths):
        layers += [nn.Linear(width, out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def linears(model: nn.Sequential) -> list[nn.Linear]:
    return [layer for layer in model if isinstance(layer, nn.Linear)]
