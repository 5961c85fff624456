from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from learner import checkpoint
from learner.algorithm import Algorithm, make_algorithm
from learner.checkpoint import CheckpointError, State
from rtcore.config import LearnerConfig, RunConfig
from rtcore.files import write_atomic
from rtcore.spaces import Spaces
from rtcore.windows import Window
from tests.learner.small import ACTION_DIM, OBSERVATION_DIM, filled_replay, forq, small_config


def state(number: float = 1.5) -> State:
    tensors = {"a": np.full((2, 3), number, np.float32), "steps": np.array(7.0, np.float32)}
    return State(tensors, {"rng": 2**127 + 1, "hidden": [4, 4], "rate": 0.1, "none": None})


def make(config: LearnerConfig, seed: int = 3) -> Algorithm:
    return make_algorithm(
        RunConfig(learner=config), Spaces(OBSERVATION_DIM, ACTION_DIM), seed, filled_replay()
    )


def learn(student: Algorithm, units: range) -> None:
    """Five updates a unit, windows of two units, the last update of each unit without the policy."""
    for unit in units:
        if unit % 2 == 0:
            student.begin_window(Window(m=unit // 2, start=unit, update=1, hold=1), unit)
        for number in range(5):
            student.update(improve_policy=number < 4)
        student.end_unit(unit)


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    assert not checkpoint.exists(tmp_path)
    checkpoint.save(tmp_path, state())
    assert checkpoint.exists(tmp_path)
    found = checkpoint.load(tmp_path)
    assert found.scalars == state().scalars
    for name, value in state().tensors.items():
        np.testing.assert_array_equal(found.tensors[name], value)
        assert (found.tensors[name].dtype, found.tensors[name].shape) == (value.dtype, value.shape)


def test_a_save_replaces_the_one_before_and_leaves_nothing_else(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, state(1.0))
    checkpoint.save(tmp_path, state(2.0))
    assert checkpoint.load(tmp_path).tensors["a"][0, 0] == 2.0
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json", ".safetensors"]


def test_a_save_cut_off_before_its_manifest_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint.save(tmp_path, state(1.0))

    def cut_off(path: Path, data: bytes) -> None:
        if path.name == checkpoint.MANIFEST:
            raise KeyboardInterrupt
        write_atomic(path, data)

    monkeypatch.setattr(checkpoint, "write_atomic", cut_off)
    with pytest.raises(KeyboardInterrupt):
        checkpoint.save(tmp_path, state(2.0))
    assert checkpoint.load(tmp_path).tensors["a"][0, 0] == 1.0


def test_none_there(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"manifest\.json: not readable \(FileNotFoundError"):
        checkpoint.load(tmp_path)


def test_a_damaged_one_is_refused(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, state())
    (tensors,) = tmp_path.glob("*.safetensors")
    data = bytearray(tensors.read_bytes())
    data[-1] ^= 1
    tensors.write_bytes(data)
    with pytest.raises(CheckpointError, match="does not have the hash"):
        checkpoint.load(tmp_path)


def test_another_schema_is_refused(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, state())
    path = tmp_path / checkpoint.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | {"schema": 9}))
    with pytest.raises(CheckpointError, match=r"schema 9 \(wanted 3\)"):
        checkpoint.load(tmp_path)


CONFIGS = {
    "sac": small_config(),
    "sac, bfloat16": small_config(precision="bfloat16"),
    "fsac, distilled": small_config(algo="fsac", forecast=forq(distil=True), precision="bfloat16"),
    "sac, fixed temperature": small_config(alpha=0.2),
    "fsac": small_config(algo="fsac", forecast=forq()),
    "fsac, judged": small_config(algo="fsac", forecast=forq(trust="judged", every=2)),
    "fsac, value network": small_config(algo="fsac", forecast=forq(), value_network=True),
    "sac, recent units": small_config(replay_recency=2.0),
    "fsac, recent replay": small_config(algo="fsac", forecast=forq(l_p=2, shrink=1.0), replay_units=3.0),
}


@pytest.mark.parametrize("name", CONFIGS)
def test_a_round_trip_goes_on_bit_for_bit(tmp_path: Path, name: str) -> None:
    config = CONFIGS[name]
    straight = make(config)
    learn(straight, range(5))  # ends midway in a window whose forecast holds copies of its own
    checkpoint.save(tmp_path, straight.state())
    resumed = make(config, seed=99)
    resumed.load(checkpoint.load(tmp_path))
    assert resumed.gradient_steps == 25
    assert resumed.policy_steps == 20
    for student in (straight, resumed):
        learn(student, range(5, 9))
    wanted, found = straight.state(), resumed.state()
    assert found.scalars == wanted.scalars
    assert found.tensors.keys() == wanted.tensors.keys()
    for key, value in wanted.tensors.items():
        assert found.tensors[key].tobytes() == value.tobytes(), key
    assert resumed.metrics() == straight.metrics()


def test_a_state_is_a_copy() -> None:
    student = make(small_config())
    before = student.state()
    kept = before.tensors["critic.0.weight"].copy()
    student.update(improve_policy=True)
    np.testing.assert_array_equal(before.tensors["critic.0.weight"], kept)


def test_loading_does_not_tie_two_learners_together() -> None:
    first, second = make(CONFIGS["fsac"]), make(CONFIGS["fsac"])
    learn(first, range(2))
    saved = first.state()
    second.load(saved)
    learn(second, range(2, 4))
    kept = first.state()
    assert all(kept.tensors[name].tobytes() == value.tobytes() for name, value in saved.tensors.items())


def test_every_difference_is_listed_and_nothing_changes() -> None:
    saved = make(small_config(algo="fsac", hidden=(8, 16), alpha=0.1)).state()
    student = make(small_config())
    before = student.state()
    with pytest.raises(CheckpointError) as caught:
        student.load(saved)
    text = str(caught.value)
    for difference in (
        "algo 'fsac' (wanted 'sac')",
        "hidden [8, 16] (wanted [16, 16])",
        "critic.0.weight float32[2, 5, 8] (wanted float32[2, 5, 16])",
        "actor.adam.m.0.bias float32[1, 1, 8] (wanted float32[1, 1, 16])",
        "temperature.log_alpha missing (wanted float32[1])",
    ):
        assert difference in text
    assert "\n" not in text
    assert "actor.heads" not in text
    after = student.state()
    assert all(after.tensors[name].tobytes() == value.tobytes() for name, value in before.tensors.items())


def test_missing_and_unknown_parts_are_named() -> None:
    student = make(CONFIGS["fsac"])
    learn(student, range(2))
    saved = student.state()
    del saved.tensors["history.2.0.bias"], saved.scalars["rng"]
    saved.tensors["extra"] = np.zeros(1, np.float32)
    with pytest.raises(CheckpointError) as caught:
        make(CONFIGS["fsac"]).load(saved)
    assert str(caught.value) == (
        "the checkpoint does not fit: extra unknown; "
        "history.2.0.bias missing (wanted float32[2, 1, 16]); rng missing"
    )
