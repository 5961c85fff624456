"""A learner's state as plain arrays and JSON, and its files: safetensors and a manifest.

A checkpoint directory holds `manifest.json` and the tensors file that it names. Renaming the
manifest is what commits a save: killed at any instant, the directory holds one whole checkpoint,
the new one or the one before.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from rtcore.files import write_atomic

MANIFEST = "manifest.json"
_SCHEMA = 3  # 2: the place in the log was in it; 1: the actor's weights were [out, in]
_KEEP_DIGITS = 16  # of the hash, in the tensors file's name


class CheckpointError(Exception):
    """A checkpoint is missing, damaged, or does not fit: one line that lists every difference."""


@dataclass(frozen=True, slots=True)
class State:
    """All that an algorithm needs to go on bit for bit, the replay aside.

    Attributes:
        tensors: arrays by name.
        scalars: anything that JSON can hold, integers of any size included.
    """

    tensors: dict[str, NDArray[Any]]
    scalars: dict[str, Any]


def exists(directory: Path) -> bool:
    """Whether `directory` holds a checkpoint."""
    return (directory / MANIFEST).is_file()


def save(directory: Path, state: State) -> None:
    """Write `state`, in place of the checkpoint that may be there. The data is on disk on return.

    Raises:
        OSError: the directory cannot be written; the old checkpoint is whole.
    """
    directory.mkdir(parents=True, exist_ok=True)
    data = safetensors.numpy.save(state.tensors)
    digest = hashlib.sha256(data).hexdigest()
    tensors = f"state-{digest[:_KEEP_DIGITS]}.safetensors"
    manifest = {"schema": _SCHEMA, "tensors": tensors, "sha256": digest, "scalars": state.scalars}
    text = json.dumps(manifest, indent=1, allow_nan=False)
    write_atomic(directory / tensors, data)
    write_atomic(directory / MANIFEST, text.encode())
    for path in directory.glob("state-*.safetensors"):
        if path.name != tensors:
            path.unlink()


def load(directory: Path) -> State:
    """The checkpoint in `directory`.

    Raises:
        CheckpointError: there is none, it is damaged, or another version wrote it.
    """
    path = directory / MANIFEST
    try:
        manifest = json.loads(path.read_bytes())
        schema, scalars = manifest["schema"], dict(manifest["scalars"])
        data = (directory / Path(manifest["tensors"]).name).read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        if schema == _SCHEMA and digest == manifest["sha256"]:
            return State(safetensors.numpy.load(data), scalars)
    except (OSError, ValueError, KeyError, TypeError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{path}: not readable ({type(error).__name__}: {error})") from error
    if schema != _SCHEMA:
        raise CheckpointError(f"{path}: schema {schema} (wanted {_SCHEMA})")
    raise CheckpointError(f"{path}: {manifest['tensors']} does not have the hash written in it")


def require_fit(found: State, wanted: State, *, same: tuple[str, ...]) -> None:
    """Check that `found` can replace `wanted`: the same tensors, all the scalars, and equal ones in `same`.

    Raises:
        CheckpointError: lists every difference.
    """
    have, want = _kinds(found), _kinds(wanted)
    differences = [
        f"{name} {have.get(name, 'missing')} (wanted {kind})"
        for name, kind in want.items()
        if have.get(name) != kind
    ]
    differences += [f"{name} unknown" for name in have if name not in want]
    for name, value in wanted.scalars.items():
        if name not in found.scalars:
            differences.append(f"{name} missing")
        elif name in same and found.scalars[name] != value:
            differences.append(f"{name} {found.scalars[name]!r} (wanted {value!r})")
    if differences:
        raise CheckpointError(f"the checkpoint does not fit: {'; '.join(sorted(differences))}")


def _kinds(state: State) -> dict[str, str]:
    return {name: f"{array.dtype}{list(array.shape)}" for name, array in state.tensors.items()}
