from __future__ import annotations

import numpy as np
import pytest

from learner.algorithm import make_algorithm
from learner.arithmetic import product_type
from learner.deep.sac import Sac
from learner.replay import Replay
from rtcore.config import LearnerConfig, RunConfig
from rtcore.spaces import Spaces
from tests.learner.plain_sac import PlainSac, linears
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, small_config


def make_sac(config: LearnerConfig | None = None, replay: Replay | None = None, seed: int = 3) -> Sac:
    if replay is None:
        replay = filled_replay()
    return Sac(config or small_config(), OBSERVATION_DIM, ACTION_DIM, seed, replay)


def train(sac: Sac, updates: int, *, improve_policy: bool = True) -> None:
    for _ in range(updates):
        sac.update(improve_policy=improve_policy)


@pytest.mark.parametrize("alpha", ["auto", 0.3])
def test_it_is_plain_sac(alpha: float | str) -> None:
    config = small_config(alpha=alpha, actor_lr=1e-2, critic_lr=2e-2, alpha_lr=3e-2, tau=0.05, gamma=0.9)
    sac = make_sac(config)
    plain = PlainSac(config, sac.state(), filled_replay())
    for _ in range(5):
        sac.update(improve_policy=True)
        plain.update()
        seen = sac.metrics()
        assert {name: seen[name] for name in plain.losses} == pytest.approx(plain.losses, rel=1e-4, abs=1e-5)
    tensors = sac.state().tensors
    trained = {"actor": [plain.actor], "critic": plain.critics, "target": plain.targets}
    for network, models in trained.items():
        for twin, model in enumerate(models):
            for layer, linear in enumerate(linears(model)):
                for kind, wanted in (("weight", linear.weight.T), ("bias", linear.bias)):
                    found = tensors[f"{network}.{layer}.{kind}"][twin].reshape(wanted.shape)
                    np.testing.assert_allclose(found, wanted.detach().numpy(), rtol=1e-3, atol=1e-5)
    assert sac.metrics()["alpha"] == pytest.approx(
        plain.log_alpha.exp().item() if alpha == "auto" else 0.3, rel=1e-5
    )


def test_a_paused_policy_keeps_every_bit() -> None:
    sac = make_sac()
    train(sac, 5)
    before = sac.state()
    train(sac, 5, improve_policy=False)
    after = sac.state()
    for name, value in before.tensors.items():
        still = name.startswith(("actor.", "temperature."))
        assert (after.tensors[name].tobytes() == value.tobytes()) is still, name
    assert (sac.gradient_steps, sac.policy_steps) == (10, 5)


def test_a_pause_does_not_change_which_batches_come() -> None:
    paused, going = make_sac(), make_sac()
    train(paused, 4, improve_policy=False)
    train(going, 4)
    assert paused.state().scalars["rng"]["batches"] == going.state().scalars["rng"]["batches"]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_equal_seeds_give_equal_bits_and_others_do_not(precision: str) -> None:
    config = small_config(precision=precision)
    first, second, other = (make_sac(config, seed=seed) for seed in (3, 3, 4))
    assert first.policy_arrays()["mean.weight"].tobytes() != other.policy_arrays()["mean.weight"].tobytes()
    for sac in (first, second, other):
        train(sac, 20)
    weights = [sac.policy_arrays() for sac in (first, second, other)]
    for name, value in weights[0].items():
        assert value.tobytes() == weights[1][name].tobytes()
    assert weights[0]["mean.weight"].tobytes() != weights[2]["mean.weight"].tobytes()


def test_only_the_newest_units_are_sampled() -> None:
    replay = Replay(1000, OBSERVATION_DIM, ACTION_DIM)
    zeros = np.zeros(OBSERVATION_DIM, np.float32), np.zeros(ACTION_DIM, np.float32)
    for unit in range(10):
        for _ in range(5):
            replay.add(zeros[0], zeros[1], float(unit), zeros[0], False, unit)
    sac = make_sac(small_config(replay_units=2.0, batch=200), replay)
    sac.update(improve_policy=True)
    assert set(sac._batch.reward) == {7, 8, 9}  # unit 9 is under way, and two whole ones


def test_newer_units_are_sampled_more_often() -> None:
    sac = make_sac(small_config(replay_recency=1.0, batch=400), filled_replay())
    sac._draw_batch()
    old = make_sac(small_config(batch=400), filled_replay())
    old._draw_batch()
    newest = filled_replay().read(140, 60).observation  # units 7, 8 and 9 of 0..9
    shares = [np.isin(one._batch.observation[:, 0], newest[:, 0]).mean() for one in (sac, old)]
    # ages 0 (units 8 and 9) and 1 of nine: (1 - e^-2) / (1 - e^-9) = 0.86, against 0.3
    assert shares == pytest.approx([0.86, 0.3], abs=0.07)


def test_metrics_before_the_first_update() -> None:
    assert make_sac().metrics() == {"alpha": 1.0}


def test_a_fixed_temperature_has_no_loss() -> None:
    sac = make_sac(small_config(alpha=0.2))
    train(sac, 3)
    assert sac.metrics().keys() == {"loss/critic", "loss/actor", "entropy", "q_mean", "alpha"}
    assert sac.metrics()["alpha"] == pytest.approx(0.2)


def test_the_temperature_falls_while_the_policy_is_more_random_than_asked() -> None:
    eager, shy = make_sac(small_config(target_entropy=-50.0)), make_sac(small_config(target_entropy=50.0))
    train(eager, 3)
    train(shy, 3)
    assert eager.metrics()["alpha"] < 1.0 < shy.metrics()["alpha"]


def test_an_empty_replay_is_refused() -> None:
    with pytest.raises(ValueError, match="no transition"):
        make_sac(replay=Replay(10, OBSERVATION_DIM, ACTION_DIM)).update(improve_policy=True)


def test_the_configuration_names_the_algorithm() -> None:
    for algo in ("sac", "fsac"):
        made = make_algorithm(
            RunConfig(learner=small_config(algo=algo)),
            Spaces(OBSERVATION_DIM, ACTION_DIM),
            0,
            filled_replay(),
        )
        assert made.algo == algo
        assert made.architecture.hidden == [16, 16]


def mean_reward(sac: Sac, replay: Replay, rng: np.random.Generator, rounds: int) -> float:
    """Act for `rounds` one-step episodes: the reward is highest at action 0.6 * observation."""
    arrays, total = sac.policy_arrays(), 0.0
    for _ in range(rounds):
        observation = rng.uniform(-1, 1, 1).astype(np.float32)
        hidden = observation
        for layer in ("trunk.0", "trunk.1"):
            hidden = np.maximum(arrays[f"{layer}.weight"] @ hidden + arrays[f"{layer}.bias"], 0)
        mean = arrays["mean.weight"] @ hidden + arrays["mean.bias"]
        log_std = np.clip(arrays["log_std.weight"] @ hidden + arrays["log_std.bias"], -20, 2)
        action = np.tanh(mean + np.exp(log_std) * rng.standard_normal(1)).astype(np.float32)
        reward = -float((action[0] - 0.6 * observation[0]) ** 2)
        replay.add(observation, action, reward, observation, True, 0)
        total += reward
    return total / rounds


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_the_products_precision(precision: str) -> None:
    sac = make_sac(small_config(precision=precision))
    train(sac, 3)
    assert str(sac._critic_net.weights[0].dtype) == f"torch.{precision}"
    assert {str(array.dtype) for array in sac.state().tensors.values()} == {"float32"}


def test_bfloat16_learns_what_float32_does() -> None:
    exact, rounded = make_sac(), make_sac(small_config(precision="bfloat16"))
    train(exact, 30)
    train(rounded, 30)
    assert rounded.metrics() == pytest.approx(exact.metrics(), rel=0.03, abs=0.01)
    assert rounded.metrics() != exact.metrics()


@pytest.mark.parametrize(
    ("has", "wanted"),
    [({"avx512_bf16": True}, "bfloat16"), ({"amx_bf16": True}, "bfloat16"), ({"avx2": True}, "float32")],
)
def test_auto_asks_the_processor(has: dict[str, bool], wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cpu.get_capabilities", lambda: has)
    assert str(product_type("auto")) == f"torch.{wanted}"
    assert str(product_type("bfloat16")) == "torch.bfloat16"
    assert str(product_type("float32")) == "torch.float32"


@pytest.mark.parametrize(
    ("algo", "precision"), [("sac", "float32"), ("sac", "bfloat16"), ("fsac", "float32")]
)
def test_it_learns(algo: str, precision: str) -> None:
    config = small_config(
        algo=algo, precision=precision, alpha=0.01, actor_lr=5e-3, critic_lr=5e-3, hidden=(32, 32), batch=64
    )
    rng, replay = np.random.default_rng(0), Replay(5000, 1, 1)
    student = make_algorithm(RunConfig(learner=config), Spaces(1, 1), 0, replay)
    assert isinstance(student, Sac)
    untrained = mean_reward(student, replay, rng, 200)
    for _ in range(10):
        train(student, 40)
        mean_reward(student, replay, rng, 20)
    assert untrained < -0.2
    assert mean_reward(student, replay, rng, 200) > -0.03
