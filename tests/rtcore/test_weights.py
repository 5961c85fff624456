from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rtcore.messages import Architecture, Policy
from rtcore.spaces import Spaces
from rtcore.weights import WeightsError, expected_shapes, pack, sha256, unpack, verify

Arrays = dict[str, npt.NDArray[Any]]
ARCHITECTURE = Architecture(kind="tanh_gaussian_mlp", observation_dim=17, action_dim=6, hidden=[64, 256])


def weights(architecture: Architecture = ARCHITECTURE, seed: int = 0) -> Arrays:
    generator = np.random.default_rng(seed)
    shapes = expected_shapes(architecture)
    return {name: generator.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def policy(arrays: Arrays, architecture: Architecture = ARCHITECTURE, digest: str | None = None) -> Policy:
    data = pack(arrays)
    return Policy(
        version=3,
        window=1,
        iterate=2,
        algo="sac",
        architecture=architecture,
        weights=data,
        sha256=digest or sha256(data),
        created_ns=5,
    )


def test_the_tensors_of_an_architecture() -> None:
    assert expected_shapes(ARCHITECTURE) == {
        "trunk.0.weight": (64, 17),
        "trunk.0.bias": (64,),
        "trunk.1.weight": (256, 64),
        "trunk.1.bias": (256,),
        "mean.weight": (6, 256),
        "mean.bias": (6,),
        "log_std.weight": (6, 256),
        "log_std.bias": (6,),
    }
    linear = Architecture(kind="tanh_gaussian_mlp", observation_dim=3, action_dim=2, hidden=[])
    assert expected_shapes(linear)["mean.weight"] == (2, 3)


def test_a_good_policy_comes_through_the_wire() -> None:
    arrays = weights()
    received = msgspec.msgpack.decode(msgspec.msgpack.encode(policy(arrays)), type=Policy)
    verified = verify(received, Spaces(17, 6))
    assert list(verified) == list(expected_shapes(ARCHITECTURE))
    for name, array in verified.items():
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, arrays[name])


def test_equal_arrays_give_equal_bytes() -> None:
    arrays = weights()
    data = pack(arrays)
    assert data == pack(dict(reversed(list(arrays.items()))))
    assert sha256(data) == sha256(pack(weights()))
    assert data != pack(weights(seed=1))


def test_the_digest_of_a_known_packing() -> None:
    """By hand: header length, header padded to 8 bytes, then the two floats."""
    data = pack({"b": np.array([1.0, -2.0], dtype=np.float32)})
    header = b'{"b":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}  '
    assert data == len(header).to_bytes(8, "little") + header + bytes.fromhex("0000803f000000c0")
    assert sha256(b"abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_views_and_foreign_byte_orders_are_packed_by_value() -> None:
    matrix = np.arange(6, dtype=np.float32).reshape(2, 3)
    for odd in (matrix.T, matrix[:, ::-1], matrix[:, :2], matrix.astype(">f4"), np.asfortranarray(matrix)):
        np.testing.assert_array_equal(unpack(pack({"x": odd}))["x"], odd)
    assert unpack(pack({"x": np.array(2.5)}))["x"].shape == ()


@given(hnp.arrays(np.float32, hnp.array_shapes(max_dims=3, min_side=0), elements=st.floats(width=32)))
def test_arrays_come_back_to_the_bit(array: npt.NDArray[np.float32]) -> None:
    back = unpack(pack({"x": array}))["x"]
    assert back.shape == array.shape and back.tobytes() == array.tobytes()


def zeros(*shape: int) -> npt.NDArray[np.float32]:
    return np.zeros(shape, np.float32)


def without(name: str) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {key: value for key, value in arrays.items() if key != name}


def having(name: str, value: npt.NDArray[Any]) -> Callable[[Arrays], Arrays]:
    return lambda arrays: arrays | {name: value}


def poisoned(name: str, value: float) -> Callable[[Arrays], Arrays]:
    def change(arrays: Arrays) -> Arrays:
        array = arrays[name].copy()
        array.flat[-1] = value
        return arrays | {name: array}

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (without("mean.bias"), "missing tensors: mean.bias"),
        (lambda arrays: {}, "missing tensors: log_std.bias, log_std.weight, mean.bias, mean.weight, "
         "trunk.0.bias, trunk.0.weight, trunk.1.bias, trunk.1.weight"),
        (having("value.weight", zeros(1)), "extra tensors: value.weight"),
        (having("a\nb", zeros(1)), "extra tensors: a\\nb"),
        (having("mean.weight", zeros(6, 64)), "mean.weight has shape (6, 64), expected (6, 256)"),
        (having("mean.weight", zeros(256, 6)), "mean.weight has shape (256, 6), expected (6, 256)"),
        (having("mean.bias", zeros(6, 1)), "mean.bias has shape (6, 1), expected (6,)"),
        (having("mean.bias", np.zeros(6)), "mean.bias is float64, expected float32"),
        (having("mean.bias", np.zeros(6, np.int32)), "mean.bias is int32, expected float32"),
        (poisoned("trunk.0.bias", float("nan")), "trunk.0.bias holds NaN"),
        (poisoned("trunk.1.weight", float("inf")), "trunk.1.weight holds Inf"),
        (poisoned("log_std.weight", float("-inf")), "log_std.weight holds Inf"),
    ],
)  # fmt: skip
def test_wrong_weights_are_refused_with_the_reason(change: Callable[[Arrays], Arrays], reason: str) -> None:
    with pytest.raises(WeightsError) as error:
        verify(policy(change(weights())), Spaces(17, 6))
    assert str(error.value) == reason


def test_many_strange_tensors_are_listed_briefly() -> None:
    strange = {f"x{number:03}" + "y" * 200: zeros(1) for number in range(100)}
    with pytest.raises(WeightsError, match=r"^extra tensors: x000y+, .* and 92 more$") as error:
        verify(policy(weights() | strange), Spaces(17, 6))
    assert len(str(error.value)) < 800


def test_a_policy_for_another_world_is_refused() -> None:
    good = policy(weights())
    with pytest.raises(WeightsError, match=r"^architecture has observation_dim 17, the environment has 23$"):
        verify(good, Spaces(23, 6))
    with pytest.raises(WeightsError, match=r"^architecture has action_dim 6, the environment has 1$"):
        verify(good, Spaces(17, 1))


def test_a_changed_byte_is_seen() -> None:
    good = policy(weights())
    changed = bytearray(good.weights)
    changed[-1] ^= 1
    with pytest.raises(WeightsError, match=r"^sha256 differs$"):
        verify(msgspec.structs.replace(good, weights=bytes(changed)), Spaces(17, 6))
    with pytest.raises(WeightsError, match=r"^sha256 differs$"):
        verify(policy(weights(), digest="0" * 64), Spaces(17, 6))


def test_layers_without_units_are_refused() -> None:
    odd = msgspec.structs.replace(ARCHITECTURE, hidden=[64, 0])
    with pytest.raises(WeightsError, match=r"^architecture has hidden \[64, 0\], expected sizes >= 1$"):
        verify(policy(weights(), odd), Spaces(17, 6))


def framed(header: bytes, body: bytes = b"") -> bytes:
    return len(header).to_bytes(8, "little") + header + body


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "^not safetensors: "),
        (b"\xff" * 64, "^not safetensors: "),
        (b"\x80\x04}\x94\x8c\x01xK\x01s.", "^not safetensors: "),
        (pack({"x": np.zeros(3)})[:-1], "^not safetensors: "),
        (pack({"x": np.zeros(3)}) + b"0", "^not safetensors: "),
        (framed(b'{"x":{"dtype":"F32","shape":[9],"data_offsets":[0,4]}}', b"0000"), "^not safetensors: "),
        (framed(b'{"x":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}}', b"0000"), "^not safetensors: "),
        (
            framed(b'{"x":{"dtype":"BF16","shape":[1],"data_offsets":[0,2]}}', b"00"),
            "^dtype BF16 is not supp",
        ),
    ],
)
def test_other_bytes_are_refused(data: bytes, reason: str) -> None:
    with pytest.raises(WeightsError, match=reason):
        unpack(data)
    good = policy(weights())
    with pytest.raises(WeightsError, match=reason):
        verify(msgspec.structs.replace(good, weights=data, sha256=sha256(data)), Spaces(17, 6))


@given(st.binary(max_size=200), st.booleans())
def test_no_bytes_raise_anything_else(data: bytes, frame: bool) -> None:
    with suppress(WeightsError):
        unpack(framed(data) if frame else data)


def test_what_safetensors_cannot_hold_is_refused() -> None:
    with pytest.raises(WeightsError, match=r"^not packable: "):
        pack({"x": np.array(["a"])})
