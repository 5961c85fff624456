"""Soft actor-critic with twin critics, soft targets and a fixed or tuned temperature.

Source: Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications". One update goes
through the temperature, the critics, the actor and the targets, in that order, and the temperature
that its losses use is the one before its own step; defaults and order are those of
stable-baselines3, so that both can be compared curve by curve. With `value_network` the critics
bootstrap from a V network, as in the first SAC and in Algorithm 2 of the paper; it learns before them.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.arithmetic import product_type
from learner.deep.durability import Durable
from learner.deep.gradients import (
    Mlp,
    Pass,
    Proposal,
    climb,
    critic_loss_to_output,
    policy_loss_to_heads,
    propose,
    smaller,
)
from learner.deep.networks import Adam, FlatParameters, make_actor, make_twin_critic, policy_arrays
from learner.deep.seen import Seen
from learner.deep.temperature import Temperature
from learner.deep.tensors import BatchTensors
from learner.deep.value_network import ValueNetwork
from learner.replay import Replay, make_batch
from learner.schedule.outlook import Outlook
from rtcore.config import LearnerConfig
from rtcore.messages import Architecture
from rtcore.windows import Window

_STREAMS = ("init", "batches", "noise", "judge")


class Sac(Durable):
    """The SAC learner. One thread owns it and its replay.

    With one torch thread, equal seeds and equal replays give bit-equal results.

    Attributes:
        architecture: of the policy that `policy_arrays` gives.
        gradient_steps: calls of `update` so far.
        policy_steps: how many of them improved the policy.
    """

    algo = "sac"

    def __init__(
        self, config: LearnerConfig, observation_dim: int, action_dim: int, seed: int, replay: Replay
    ) -> None:
        self._config, self._replay = config, replay
        self.architecture = Architecture(
            kind="tanh_gaussian_mlp",
            observation_dim=observation_dim,
            action_dim=action_dim,
            hidden=list(config.hidden),
        )
        self.gradient_steps = 0
        self.policy_steps = 0
        self.unread = 0  # batches are drawn
        streams = np.random.SeedSequence(seed).spawn(len(_STREAMS))
        self._rng = {name: np.random.default_rng(s) for name, s in zip(_STREAMS, streams, strict=True)}
        self._build_networks()
        entropy = -float(action_dim) if config.target_entropy is None else config.target_entropy
        self._temperature = Temperature(config.alpha, config.alpha_lr, entropy)
        self._batch = make_batch(config.batch, observation_dim, action_dim)
        self._sampled = BatchTensors(self._batch)
        self._build_passes()
        self._seen = Seen()

    def _build_networks(self) -> None:
        shape, hidden = self.architecture, self._config.hidden
        init = self._rng["init"]
        self._actor = make_actor(shape.observation_dim, shape.action_dim, hidden, init)
        self._critic = make_twin_critic(shape.observation_dim, shape.action_dim, hidden, init)
        self._target = make_twin_critic(shape.observation_dim, shape.action_dim, hidden, None)
        self._target.flat.copy_(self._critic.flat)
        self._actor_adam = Adam(self._actor.flat, self._actor.grad, self._config.actor_lr)
        self._critic_adam = Adam(self._critic.flat, self._critic.grad, self._config.critic_lr)

    def _build_passes(self) -> None:
        """The networks ready for products, and room for a batch on its way through them.

        The actor takes s in its first B rows and s' in the others, so that an update needs one pass
        through it.
        """
        shape, rows = self.architecture, self._config.batch
        self._precision = product_type(self._config.precision)
        networks = (self._actor, self._critic, self._target)
        self._actor_net, self._critic_net, self._target_net = (
            Mlp(network, self._precision) for network in networks
        )
        observation, action, hidden = shape.observation_dim, shape.action_dim, list(shape.hidden)
        self._both = Pass(1, 2 * rows, [observation, *hidden, 2 * action], self._precision)
        self._now, self._next = self._both.rows(0, rows), self._both.rows(rows, 2 * rows)
        self._values = Pass(2, rows, [observation + action, *hidden, 1], self._precision)
        self._value_network: ValueNetwork | None = None
        if self._config.value_network:
            self._value_network = ValueNetwork(
                [observation, *hidden, 1], rows, self._rng["init"], self._config.critic_lr, self._precision
            )
        self._noise = np.zeros((2 * rows, action), np.float32)

    # -- learning

    def update(self, *, improve_policy: bool) -> None:
        """One gradient step on one batch: critics and targets, and with `improve_policy` the policy.

        Without it, the actor, the temperature and the state of their optimisers stay as they are.

        Raises:
            ValueError: the replay holds no transition.
        """
        self._draw_batch()
        if self._value_network is None:
            self._update_by_targets(self._temperature.value, improve_policy)
        else:
            self._update_by_value(self._value_network, self._temperature.value, improve_policy)
        self.gradient_steps += 1
        self.policy_steps += improve_policy

    def _update_by_targets(self, alpha: float, improve_policy: bool) -> None:
        if improve_policy:
            now, following = self._propose_both()
            self._temperature_step(now.log_prob)
            self._critic_step(self._soft_value(alpha, following))
            self._actor_step(alpha, now)
        else:
            following = self._propose(self._next, self._sampled.next_observation)
            self._critic_step(self._soft_value(alpha, following))
        self._target.flat.lerp_(self._critic.flat, self._config.tau)
        self._target_net.refresh()

    def _update_by_value(self, value: ValueNetwork, alpha: float, improve_policy: bool) -> None:
        batch = self._sampled
        now = self._propose(self._now, batch.observation)
        if improve_policy:
            self._temperature_step(now.log_prob)
        q = smaller(self._evaluate(self._critic_net, batch.observation, now.action))
        value.learn(batch.observation, q - alpha * now.log_prob)
        self._critic_step(value.bootstrap(batch.next_observation))
        if improve_policy:
            self._actor_step(alpha, now)
        value.follow(self._config.tau)

    def _draw_batch(self, stream: str = "batches") -> None:
        recency = self._config.replay_recency
        self._replay.sample(self._rng[stream], self._batch, self._since_unit(), recency)

    def _since_unit(self) -> int | None:
        """The oldest unit to draw from: the one under way is not whole yet, so it comes on top."""
        units = self._config.replay_units
        return None if units is None else self._replay.newest_unit - math.ceil(units)

    def _propose_both(self) -> tuple[Proposal, Proposal]:
        """Actions of the policy at s and at s'."""
        self._now.input.copy_(self._sampled.observation)
        self._next.input.copy_(self._sampled.next_observation)
        self._rng["noise"].standard_normal(dtype=np.float32, out=self._noise)
        drawn = propose(self._both.forward(self._actor_net)[0], torch.from_numpy(self._noise))
        rows = self._config.batch
        return Proposal(*(part[:rows] for part in drawn)), Proposal(*(part[rows:] for part in drawn))

    def _propose(self, room: Pass, observation: Tensor, stream: str = "noise") -> Proposal:
        """Actions of the policy at `observation`, [B, O], which passes through `room`."""
        room.input.copy_(observation)
        noise = self._noise[: self._config.batch]
        self._rng[stream].standard_normal(dtype=np.float32, out=noise)
        return propose(room.forward(self._actor_net)[0], torch.from_numpy(noise))

    def _evaluate(self, net: Mlp, observation: Tensor, action: Tensor) -> Tensor:
        """Both critics' values, [2, B, 1]; the next pass overwrites them."""
        self._enter(observation, action)
        return self._values.forward(net)

    def _enter(self, observation: Tensor, action: Tensor) -> None:
        columns = self.architecture.observation_dim
        self._values.input[:, :columns] = observation
        self._values.input[:, columns:] = action

    def _temperature_step(self, log_prob: Tensor) -> None:
        self._seen.log_prob = log_prob
        self._temperature.step(log_prob)

    def _critic_step(self, next_value: Tensor) -> None:
        """Descend on J(Q) = 1/2 sum_i mean (Q_i(s, a) - y)^2, y = r + gamma (1 - terminated) next value."""
        batch = self._sampled
        target = batch.reward + self._config.gamma * next_value.masked_fill(batch.terminated, 0.0)
        q = self._evaluate(self._critic_net, batch.observation, batch.action)
        d_q = critic_loss_to_output(q, target)
        self._values.to_parameters(self._critic_net, d_q)
        self._critic_adam.step()
        self._critic_net.refresh()
        self._seen.d_q, self._seen.target = d_q, target

    def _soft_value(self, alpha: float, following: Proposal) -> Tensor:
        """min_i Qtarget_i(s', a') - alpha log pi(a'|s'), [B]."""
        q = self._evaluate(self._target_net, self._sampled.next_observation, following.action)
        return smaller(q) - alpha * following.log_prob

    def _actor_step(self, alpha: float, now: Proposal) -> None:
        """Descend on J(pi) = mean (alpha log pi(a|s) - Q(s, a)), a drawn from pi."""
        self._enter(self._sampled.observation, now.action)
        value, q_to_action = self._climb()
        d_heads = policy_loss_to_heads(now, q_to_action, alpha)
        self._now.to_parameters(self._actor_net, d_heads[None])
        self._actor_adam.step()
        self._actor_net.refresh()
        self._seen.value, self._seen.soft = value, alpha * now.log_prob

    def _climb(self) -> tuple[Tensor, Tensor]:
        """The Q that the policy climbs at (s, a) of the pass, [B], and its gradient in a, [B, A]."""
        return climb(self._values, self._critic_net, self.architecture.action_dim)

    def iterate(self, g: int) -> bool:
        """SAC improves its policy by `update`."""
        del g
        return False

    def begin_window(self, window: Window, unit: int) -> None:
        """SAC makes no forecast."""

    def outlook(self, start: int, length: int) -> Outlook | None:  # noqa: ARG002 (for subclasses)
        """SAC foresees nothing."""
        return None

    def end_unit(self, unit: int) -> None:
        """SAC keeps no past critics."""

    # -- reading

    def policy_arrays(self) -> dict[str, NDArray[np.float32]]:
        """Float32 copies of the policy's parameters, under the names of `rtcore.weights`."""
        return policy_arrays(self._actor, self.architecture.action_dim)

    def metrics(self) -> dict[str, float]:
        """What the newest update saw; a name is missing as long as there is nothing to say.

        loss/critic, loss/actor, loss/alpha: J(Q), J(pi), J(alpha); loss/value: J(V), with a V network;
        alpha: the temperature now; entropy: mean -log pi on the batch; q_mean: mean over batch and
        critics of Q(s, a).
        """
        found = self._seen.metrics()
        if "entropy" in found and (loss := self._temperature.loss(found["entropy"])) is not None:
            found["loss/alpha"] = loss
        if self._value_network is not None:
            found |= self._value_network.metrics()
        return found | {"alpha": self._temperature.value}

    # -- durability

    def _trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        trained = {"actor": (self._actor, self._actor_adam), "critic": (self._critic, self._critic_adam)}
        if self._temperature.tuned:
            trained["temperature"] = (self._temperature.parameters, self._temperature.adam)
        if self._value_network is not None:
            trained["value"] = (self._value_network.parameters, self._value_network.adam)
        return trained

    def _followers(self) -> dict[str, FlatParameters]:
        value = self._value_network
        return {"target": self._target} if value is None else {"value_target": value.target}

    def _reloaded(self) -> None:
        self._seen = Seen()
        self._temperature.forget()
        if self._value_network is not None:
            self._value_network.refresh()
        for net in (self._actor_net, self._critic_net, self._target_net):
            net.refresh()
