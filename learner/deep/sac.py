"""Soft actor-critic with twin critics, soft targets and a fixed or tuned temperature.

Source: Haarnoja et al. (2018), "Soft Actor-Critic Algorithms and Applications". One update goes
through the temperature, the critics, the actor and the targets, in that order, and the temperature
that its losses use is the one before its own step; defaults and order are those of
stable-baselines3, so that both can be compared curve by curve.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learner.arithmetic import product_type
from learner.checkpoint import State, require_fit
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
from learner.deep.tensors import BatchTensors
from learner.replay import Replay, make_batch
from rtcore.config import LearnerConfig
from rtcore.messages import Architecture
from rtcore.windows import Window

_SAME = ("algo", "observation_dim", "action_dim", "hidden")  # what a checkpoint must agree on
_STREAMS = ("init", "batches", "noise", "judge")


class Sac:
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
        streams = np.random.SeedSequence(seed).spawn(len(_STREAMS))
        self._rng = {name: np.random.default_rng(s) for name, s in zip(_STREAMS, streams, strict=True)}
        self._build_networks()
        self._build_temperature()
        self._batch = make_batch(config.batch, observation_dim, action_dim)
        self._sampled = BatchTensors(self._batch)
        self._build_passes()
        self._last: dict[str, Tensor] = {}  # what `metrics` reads, not yet fetched

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
        self._noise = np.zeros((2 * rows, action), np.float32)

    def _build_temperature(self) -> None:
        config = self._config
        self._tuned = config.alpha == "auto"
        self._fixed_alpha = 1.0 if config.alpha == "auto" else config.alpha
        self._log_alpha = FlatParameters({"log_alpha": (1,)})  # tuned from alpha = 1 on
        self._alpha_adam = Adam(self._log_alpha.flat, self._log_alpha.grad, config.alpha_lr)
        entropy = config.target_entropy
        self._target_entropy = -float(self.architecture.action_dim) if entropy is None else entropy

    # -- learning

    def update(self, *, improve_policy: bool) -> None:
        """One gradient step on one batch: critics and targets, and with `improve_policy` the policy.

        Without it, the actor, the temperature and the state of their optimisers stay as they are.

        Raises:
            ValueError: the replay holds no transition.
        """
        self._draw_batch()
        alpha = math.exp(self._log_alpha.flat[0].item()) if self._tuned else self._fixed_alpha
        if improve_policy:
            now, following = self._propose_both()
            self._temperature_step(now.log_prob)
            self._critic_step(alpha, following)
            self._actor_step(alpha, now)
            self.policy_steps += 1
        else:
            self._critic_step(alpha, self._propose_next())
        self._target.flat.lerp_(self._critic.flat, self._config.tau)
        self._target_net.refresh()
        self.gradient_steps += 1

    def _draw_batch(self, stream: str = "batches") -> None:
        since = None
        if self._config.replay_units is not None:
            # the unit under way is not whole yet, so it comes on top
            since = self._replay.newest_unit - math.ceil(self._config.replay_units)
        self._replay.sample(self._rng[stream], self._batch, since)

    def _propose_both(self) -> tuple[Proposal, Proposal]:
        """Actions of the policy at s and at s'."""
        self._now.input.copy_(self._sampled.observation)
        self._next.input.copy_(self._sampled.next_observation)
        self._rng["noise"].standard_normal(dtype=np.float32, out=self._noise)
        drawn = propose(self._both.forward(self._actor_net)[0], torch.from_numpy(self._noise))
        rows = self._config.batch
        return Proposal(*(part[:rows] for part in drawn)), Proposal(*(part[rows:] for part in drawn))

    def _propose_next(self) -> Proposal:
        """Actions of the policy at s'."""
        self._next.input.copy_(self._sampled.next_observation)
        noise = self._noise[: self._config.batch]
        self._rng["noise"].standard_normal(dtype=np.float32, out=noise)
        return propose(self._next.forward(self._actor_net)[0], torch.from_numpy(noise))

    def _evaluate(self, net: Mlp, observation: Tensor, action: Tensor) -> Tensor:
        """Both critics' values, [2, B, 1]; the next pass overwrites them."""
        self._enter(observation, action)
        return self._values.forward(net)

    def _enter(self, observation: Tensor, action: Tensor) -> None:
        columns = self.architecture.observation_dim
        self._values.input[:, :columns] = observation
        self._values.input[:, columns:] = action

    def _temperature_step(self, log_prob: Tensor) -> None:
        """Descend on J(alpha) = -log(alpha) * mean(log pi + target entropy)."""
        self._last["log_prob"] = log_prob
        if not self._tuned:
            return
        self._last["log_alpha"] = self._log_alpha.flat[0].clone()
        self._log_alpha.grad[0] = -(log_prob.mean() + self._target_entropy)
        self._alpha_adam.step()

    def _critic_step(self, alpha: float, following: Proposal) -> None:
        """Descend on J(Q) = 1/2 sum_i mean (Q_i(s, a) - y)^2, y the soft target."""
        target = self._soft_target(alpha, following)
        q = self._evaluate(self._critic_net, self._sampled.observation, self._sampled.action)
        d_q = critic_loss_to_output(q, target)
        self._values.to_parameters(self._critic_net, d_q)
        self._critic_adam.step()
        self._critic_net.refresh()
        self._last["d_q"], self._last["target"] = d_q, target

    def _soft_target(self, alpha: float, following: Proposal) -> Tensor:
        """Soft target y = r + gamma (1 - terminated) (min_i Qtarget_i(s', a') - alpha log pi(a'|s')), [B]."""
        batch = self._sampled
        q = self._evaluate(self._target_net, batch.next_observation, following.action)
        value = smaller(q) - alpha * following.log_prob
        return batch.reward + self._config.gamma * value.masked_fill_(batch.terminated, 0.0)

    def _actor_step(self, alpha: float, now: Proposal) -> None:
        """Descend on J(pi) = mean (alpha log pi(a|s) - Q(s, a)), a drawn from pi."""
        self._enter(self._sampled.observation, now.action)
        value, q_to_action = self._climb()
        d_heads = policy_loss_to_heads(now, q_to_action, alpha)
        self._now.to_parameters(self._actor_net, d_heads[None])
        self._actor_adam.step()
        self._actor_net.refresh()
        self._last["value"], self._last["soft"] = value, alpha * now.log_prob

    def _climb(self) -> tuple[Tensor, Tensor]:
        """The Q that the policy climbs at (s, a) of the pass, [B], and its gradient in a, [B, A]."""
        return climb(self._values, self._critic_net, self.architecture.action_dim)

    def iterate(self, g: int) -> bool:
        """SAC improves its policy by `update`."""
        del g
        return False

    def begin_window(self, window: Window, unit: int) -> None:
        """SAC makes no forecast."""

    def end_unit(self, unit: int) -> None:
        """SAC keeps no past critics."""

    # -- reading

    def policy_arrays(self) -> dict[str, NDArray[np.float32]]:
        """Float32 copies of the policy's parameters, under the names of `rtcore.weights`."""
        return policy_arrays(self._actor, self.architecture.action_dim)

    def metrics(self) -> dict[str, float]:
        """What the newest update saw; a name is missing as long as there is nothing to say.

        loss/critic, loss/actor, loss/alpha: J(Q), J(pi), J(alpha) above; alpha: the temperature
        now; entropy: mean -log pi on the batch; q_mean: mean over batch and critics of Q(s, a).
        """
        last: dict[str, Tensor] = self._last
        found: dict[str, float] = {}
        if "d_q" in last:
            error = last["d_q"] * self._config.batch
            found["loss/critic"] = 0.5 * error.square().mean(1).sum().item()
            found["q_mean"] = (error + last["target"][:, None]).mean().item()
        if "value" in last:
            found["loss/actor"] = (last["soft"] - last["value"]).mean().item()
        if "log_prob" in last:
            found["entropy"] = -last["log_prob"].mean().item()
        if "log_alpha" in last:
            found["loss/alpha"] = last["log_alpha"].item() * (found["entropy"] - self._target_entropy)
        found["alpha"] = self._log_alpha.flat[0].exp().item() if self._tuned else self._fixed_alpha
        return found

    # -- durability

    def state(self) -> State:
        """Everything needed to go on bit for bit, as copies; the replay is not in it."""
        tensors = {name: view.numpy().copy() for name, view in self._durable().items()}
        scalars: dict[str, Any] = {
            "algo": self.algo,
            "observation_dim": self.architecture.observation_dim,
            "action_dim": self.architecture.action_dim,
            "hidden": list(self.architecture.hidden),
            "gradient_steps": self.gradient_steps,
            "policy_steps": self.policy_steps,
            "rng": {name: rng.bit_generator.state for name, rng in self._rng.items()},
        }
        return State(tensors, scalars)

    def load(self, state: State) -> None:
        """Go on from `state`.

        Raises:
            CheckpointError: it does not fit this configuration; nothing has changed then.
        """
        require_fit(state, State(self._expected_tensors(state), self.state().scalars), same=_SAME)
        for name, view in self._durable().items():
            view.copy_(torch.from_numpy(state.tensors[name].copy()))
        for name, rng in self._rng.items():
            rng.bit_generator.state = state.scalars["rng"][name]
        self.gradient_steps = int(state.scalars["gradient_steps"])
        self.policy_steps = int(state.scalars["policy_steps"])
        self._last = {}
        for net in (self._actor_net, self._critic_net, self._target_net):
            net.refresh()

    def _expected_tensors(self, state: State) -> dict[str, NDArray[Any]]:  # noqa: ARG002 (for subclasses)
        """The tensors that `state`, going by its scalars, should have."""
        return {name: view.numpy() for name, view in self._durable().items()}

    def _durable(self) -> dict[str, Tensor]:
        """The tensors that a checkpoint keeps, by name: views, so that `load` writes through them."""
        durable = {f"target.{name}": view for name, view in self._target.views(self._target.flat).items()}
        for network, (parameters, optimiser) in self._trained().items():
            buffers = {"": parameters.flat, "adam.m.": optimiser.moment1, "adam.v.": optimiser.moment2}
            for kind, buffer in buffers.items():
                durable |= {f"{network}.{kind}{n}": view for n, view in parameters.views(buffer).items()}
            durable[f"{network}.adam.steps"] = optimiser.steps
        return durable

    def _trained(self) -> dict[str, tuple[FlatParameters, Adam]]:
        trained = {"actor": (self._actor, self._actor_adam), "critic": (self._critic, self._critic_adam)}
        if self._tuned:
            trained["temperature"] = (self._log_alpha, self._alpha_adam)
        return trained
