"""Policy weights on the wire: packed as safetensors, and checked whole before anybody acts on them.

Safetensors holds names, shapes and raw numbers, so a hostile file is at worst a wrong policy, never code.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors import numpy as safetensors_numpy

from rtcore.messages import Architecture, Policy
from rtcore.spaces import Spaces

Array = npt.NDArray[np.generic]
Float32Array = npt.NDArray[np.float32]

_SUM_TOLERANCE = 1e-4  # of a row of probabilities, in float32


class WeightsError(ValueError):
    """Weights that cannot be used; the message is the short, specific reason."""


def pack(arrays: Mapping[str, Array]) -> bytes:
    """Named arrays as safetensors bytes: equal arrays give equal bytes, whatever the order of the mapping.

    Raises:
        WeightsError: an array of a dtype that safetensors cannot hold.
    """
    # safetensors 0.8 writes the memory of a strided view as it lies, and so another array than was meant.
    plain = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    try:
        return bytes(safetensors_numpy.save(plain))
    except SafetensorError as error:
        raise WeightsError(f"not packable: {error}") from error


def unpack(data: bytes) -> dict[str, Array]:
    """The named arrays in safetensors bytes.

    Raises:
        WeightsError: the bytes are no safetensors, or hold a dtype that NumPy has not.
    """
    try:
        arrays: dict[str, Array] = safetensors_numpy.load(data)
    except KeyError as error:
        raise WeightsError(f"dtype {error.args[0]} is not supported") from error
    except (SafetensorError, ValueError) as error:
        raise WeightsError(f"not safetensors: {error}") from error
    return arrays


def sha256(data: bytes) -> str:
    """Hex digest of packed weights."""
    return hashlib.sha256(data).hexdigest()


def expected_shapes(architecture: Architecture) -> dict[str, tuple[int, ...]]:
    """Tensor name -> shape of a policy of this architecture, in the order of the forward pass.

    A table is `probability`, [states, actions]. A network's weight is [outputs, inputs] and a layer computes
    `weight @ x + bias`; ReLU follows each `trunk` layer. The heads `mean` and `log_std` both read the last
    trunk layer (the observation, if there is none).
    """
    if architecture.kind == "categorical_table":
        return {"probability": (architecture.states, architecture.actions)}
    shapes: dict[str, tuple[int, ...]] = {}
    inputs = architecture.observation_dim
    for layer, outputs in enumerate(architecture.hidden):
        shapes |= {f"trunk.{layer}.weight": (outputs, inputs), f"trunk.{layer}.bias": (outputs,)}
        inputs = outputs
    for head in ("mean", "log_std"):
        shapes[f"{head}.weight"] = (architecture.action_dim, inputs)
        shapes[f"{head}.bias"] = (architecture.action_dim,)
    return shapes


def verify(policy: Policy, spaces: Spaces) -> dict[str, Float32Array]:
    """The weights of a policy that can act in `spaces`.

    Raises:
        WeightsError: hash, dimensions, tensor names, shapes, dtype or values are wrong; says which.
    """
    if sha256(policy.weights) != policy.sha256:
        raise WeightsError("sha256 differs")
    for name in ("observation_dim", "action_dim", "states", "actions"):
        _check_dimension(name, getattr(policy.architecture, name), getattr(spaces, name))
    if any(size < 1 for size in policy.architecture.hidden):
        raise WeightsError(f"architecture has hidden {policy.architecture.hidden}, expected sizes >= 1")
    if spaces.finite != (policy.architecture.kind == "categorical_table"):
        raise WeightsError(f"a {policy.architecture.kind} cannot act in this world")
    arrays = unpack(policy.weights)
    shapes = expected_shapes(policy.architecture)
    _check_names(arrays.keys(), shapes.keys())
    checked = {name: _checked(name, arrays[name], shape) for name, shape in shapes.items()}
    if spaces.finite:
        _check_probabilities(checked["probability"])
    return checked


def _check_probabilities(table: Float32Array) -> None:
    if (table < 0).any() or (abs(table.sum(axis=1) - 1) > _SUM_TOLERANCE).any():
        raise WeightsError("probability holds rows that are no distribution")


def _check_dimension(name: str, policy: int, environment: int) -> None:
    if policy != environment:
        raise WeightsError(f"architecture has {name} {policy}, the environment has {environment}")


def _check_names(found: Iterable[str], expected: Iterable[str]) -> None:
    missing, extra = sorted(set(expected) - set(found)), sorted(set(found) - set(expected))
    if missing:
        raise WeightsError(f"missing tensors: {_listed(missing)}")
    if extra:
        raise WeightsError(f"extra tensors: {_listed(extra)}")


def _checked(name: str, array: Array, shape: tuple[int, ...]) -> Float32Array:
    if array.dtype != np.float32:
        raise WeightsError(f"{name} is {array.dtype}, expected float32")
    if array.shape != shape:
        raise WeightsError(f"{name} has shape {array.shape}, expected {shape}")
    values = array.astype(np.float32, copy=False)
    if not np.isfinite(values).all():
        raise WeightsError(f"{name} holds {'NaN' if np.isnan(values).any() else 'Inf'}")
    return values


def _listed(names: list[str]) -> str:
    """Names on one line of bounded length, whatever a stranger put into them."""
    shown = ", ".join(repr(name)[1:-1][:80] for name in names[:8])
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"
