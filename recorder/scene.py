"""The world in 3-D: shapes once, then where each body is. Kinematics are computed here, from positions.

At control rates above 60 Hz only every n-th tick is drawn, n = round(rate / 50 Hz): about 50 pictures a
second, at a third of the recording's bytes or less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from recorder.rows import Floats, Poses, Singles
from rtcore.messages import Spec, Step

ROOT = "/world"
FOLLOW = f"{ROOT}/follow"  # a frame that goes with the robot and never turns: the 3-D view's own
GROUND = f"{ROOT}/ground"
GROUND_X_M, GROUND_Y_M = (-100, 400), 5
GROUND_COLOUR = [70, 76, 88]
MAX_HZ = 60.0  # up to here every tick is drawn
DRAWN_HZ = 50.0
POINT = f"{ROOT}/point"


@dataclass(frozen=True, slots=True)
class Shape:
    """What an entity looks like, always."""

    entity: str
    archetype: rr.AsComponents


@dataclass(frozen=True, slots=True)
class Camera:
    """Where the viewer's eye is and what it looks at, in metres, in the frame `FOLLOW`."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]


def camera(size_m: float, height_m: float) -> Camera:
    """Sees something of `size_m` across from the side, whose middle is `height_m` above the ground."""
    return Camera((0.15 * size_m, -1.1 * size_m, height_m + 0.25 * size_m), (0.0, 0.0, 0.8 * height_m))


class Scene(Protocol):
    """How a kind of world is drawn."""

    camera: Camera

    def shapes(self) -> list[Shape]:
        """Everything that never changes."""

    def fits(self, numbers: float) -> bool:
        """Whether a position of so many numbers can be drawn."""

    def poses(self, positions: Sequence[Floats]) -> dict[str, Poses]:
        """Where each moving entity is, for n positions as in `Step.position`."""


def drawn_every(spec: Spec) -> int:
    """n: every n-th tick is drawn."""
    hz = 1e9 / spec.tick_ns
    return 1 if hz <= MAX_HZ else max(1, round(hz / DRAWN_HZ))


def drawn(steps: Sequence[Step], every: int, scene: Scene) -> list[Step]:
    """The steps to draw: every n-th tick, and only with a position that fits the scene."""
    return [step for step in steps if step.tick % every == 0 and scene.fits(len(step.position) / 8)]


def positions(steps: Sequence[Step]) -> list[Floats]:
    """`Step.position` as float64 arrays."""
    return [np.frombuffer(step.position, "<f8") for step in steps]


def follow(places: Singles) -> Poses:
    """The frame that goes with something at `places`, float32 [n, 3], on the ground below it."""
    return Poses(places * np.array([1, 1, 0], np.float32))


def ground() -> Shape:
    """Lines a metre apart on z = 0, for a robot that goes along x: they show how fast it goes."""
    (begin, end), side = GROUND_X_M, GROUND_Y_M
    across = [np.array([[x, -side, 0], [x, side, 0]], np.float32) for x in range(begin, end + 1)]
    along = [np.array([[begin, y, 0], [end, y, 0]], np.float32) for y in range(-side, side + 1)]
    return Shape(GROUND, rr.LineStrips3D(strips=[*across, *along], colors=[GROUND_COLOUR], radii=[0.004]))


class PointScene:
    """A ball that moves along x, or in the plane, or in space: position float64 [1..3] in metres."""

    camera = camera(2.0, 0.0)

    def shapes(self) -> list[Shape]:
        """The ball and the ground."""
        ball = rr.Ellipsoids3D(half_sizes=[[0.15] * 3], colors=[[255, 162, 58]], fill_mode="solid")
        return [Shape(POINT, ball), ground()]

    def fits(self, numbers: float) -> bool:
        """One to three coordinates."""
        return numbers in (1, 2, 3)

    def poses(self, positions: Sequence[Floats]) -> dict[str, Poses]:
        """The ball's place; missing coordinates are 0."""
        places = np.zeros((len(positions), 3), np.float32)
        for place, position in zip(places, positions, strict=True):
            place[: len(position)] = position[:3]
        return {POINT: Poses(places), FOLLOW: follow(places)}


class MujocoScene:
    """A MuJoCo robot: position is qpos, float64 [nq]. Planes, meshes and height fields are not drawn."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._data = mujoco.MjData(model)
        self._entities = [f"{ROOT}/{self._body_name(body)}" for body in range(model.nbody)]
        self._root = min(1, model.nbody - 1)
        self.camera = self._camera()

    @classmethod
    def load(cls, path: Path) -> MujocoScene:
        """Read a model that the env server saved.

        Raises:
            OSError: it is not there.
            ValueError: it is no model.
        """
        if not path.is_file():
            raise FileNotFoundError(f"{path.name} is not there")
        return cls(mujoco.MjModel.from_binary_path(str(path)))

    def shapes(self) -> list[Shape]:
        """One entity per geometry, below its body's, in the body's frame; and the ground."""
        shapes = [ground()]
        for geom in range(self._model.ngeom):
            archetype = self._shape(geom)
            if archetype is not None:
                body = int(self._model.geom_bodyid[geom])
                parent = self._entities[body] if body else f"{ROOT}/static"
                shapes.append(Shape(f"{parent}/g{geom}", archetype))
        return shapes

    def fits(self, numbers: float) -> bool:
        """As many as the model's qpos."""
        return bool(numbers == self._model.nq)

    def poses(self, positions: Sequence[Floats]) -> dict[str, Poses]:
        """World pose of every body but the world itself, and of `FOLLOW`. 3 us a position for HalfCheetah."""
        n, bodies = len(positions), self._model.nbody
        places, turns = np.empty((n, bodies, 3), np.float32), np.empty((n, bodies, 4), np.float32)
        for i, position in enumerate(positions):
            self._data.qpos[:] = position
            mujoco.mj_kinematics(self._model, self._data)
            places[i], turns[i] = self._data.xpos, self._data.xquat
        turns = _xyzw(turns)
        poses = {self._entities[b]: Poses(places[:, b], turns[:, b]) for b in range(1, bodies)}
        return poses | {FOLLOW: follow(places[:, self._root])}

    def _body_name(self, body: int) -> str:
        name = str(self._model.body(body).name)
        plain = name.replace("_", "").replace("-", "").isalnum() and f"{ROOT}/{name}" not in (FOLLOW, GROUND)
        return name if plain else f"body{body}"

    def _camera(self) -> Camera:
        """Fits what can be drawn, in the model's first position."""
        mujoco.mj_kinematics(self._model, self._data)
        middle = self._data.xpos[self._root]
        reach = 0.0
        for geom in range(self._model.ngeom):
            if self._shape(geom) is not None:
                far = np.linalg.norm(self._data.geom_xpos[geom] - middle) + self._model.geom_rbound[geom]
                reach = max(reach, float(far))
        return camera(2 * reach, max(float(middle[2]), 0.0))

    def _shape(self, geom: int) -> rr.AsComponents | None:
        size, place = self._model.geom_size[geom], self._model.geom_pos[geom]
        turn = self._model.geom_quat[geom]
        looks: dict[str, Any] = {
            "quaternions": [_xyzw(turn)],
            "colors": [np.round(self._model.geom_rgba[geom] * 255).astype(np.uint8)],
            "fill_mode": "solid",
        }
        match int(self._model.geom_type[geom]):
            case mujoco.mjtGeom.mjGEOM_CAPSULE:  # Rerun's begins at its origin, MuJoCo's is centred
                start = place - _turned([0.0, 0.0, size[1]], turn)
                return rr.Capsules3D(lengths=[2 * size[1]], radii=[size[0]], translations=[start], **looks)
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                return rr.Ellipsoids3D(half_sizes=[[size[0]] * 3], centers=[place], **looks)
            case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
                return rr.Ellipsoids3D(half_sizes=[size], centers=[place], **looks)
            case mujoco.mjtGeom.mjGEOM_CYLINDER:
                return rr.Cylinders3D(lengths=[2 * size[1]], radii=[size[0]], centers=[place], **looks)
            case mujoco.mjtGeom.mjGEOM_BOX:
                return rr.Boxes3D(half_sizes=[size], centers=[place], **looks)
        return None


def _xyzw(wxyz: NDArray[np.floating]) -> NDArray[np.floating]:
    """From MuJoCo's order of a quaternion to Rerun's; [..., 4]."""
    return wxyz[..., [1, 2, 3, 0]]


def _turned(vector: Sequence[float], quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, np.asarray(vector, np.float64), np.asarray(quaternion, np.float64))
    return result
