"""The robot in 3-D is where MuJoCo says it is."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import msgspec
import mujoco
import numpy as np
import pytest
import rerun as rr

from recorder import reading
from recorder.scene import MujocoScene, PointScene, drawn, drawn_every
from tests.recorder.stage import MS, SPEC, T0, make_step, set_stage

BODIES = ["torso", "bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]


@pytest.fixture(scope="module")
def cheetah(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """HalfCheetah's model, as an env server saves it."""
    path = tmp_path_factory.mktemp("world") / "world.mjb"
    source = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "half_cheetah.xml"
    mujoco.mj_saveModel(mujoco.MjModel.from_xml_path(str(source)), str(path), None)
    return path


def qpos(seq: int) -> np.ndarray:
    return np.random.default_rng(seq).uniform(-1, 1, 9)


def test_bodies_in_the_file_are_where_the_kinematics_put_them(cheetah: Path, tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    cheetah_in_run = stage.run_dir.world_path
    cheetah_in_run.write_bytes(cheetah.read_bytes())
    stage.spec.put(msgspec.structs.replace(SPEC, scene="mujoco"))
    stage.steps([make_step(seq, position=qpos(seq).astype("<f8").tobytes()) for seq in range(60)], last=True)
    stage.service.close()
    assert stage.events() == []

    model = mujoco.MjModel.from_binary_path(str(cheetah))
    data = mujoco.MjData(model)
    places, turns = np.empty((60, 8, 3)), np.empty((60, 8, 4))
    for seq in range(60):
        data.qpos[:] = qpos(seq)
        mujoco.mj_kinematics(model, data)
        places[seq], turns[seq] = data.xpos, data.xquat
    for number, body in enumerate(BODIES, start=1):
        ticks, translation = reading.columns(stage.path, f"/world/{body}", reading.TRANSLATION)
        quaternion = reading.columns(stage.path, f"/world/{body}", reading.QUATERNION)[1]
        assert ticks.tolist() == list(range(60))
        np.testing.assert_allclose(translation, places[:, number], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(quaternion[:, [3, 0, 1, 2]], turns[:, number], rtol=1e-6, atol=1e-6)
    shapes = [entity for entity in reading.entities(stage.path) if entity.rpartition("/g")[2].isdigit()]
    assert len(shapes) == 8  # torso and head, six limbs; the floor is a plane


def test_a_capsule_begins_at_the_end_that_mujoco_means(cheetah: Path) -> None:
    """Rerun's capsule goes from its translation along its own z for its length; MuJoCo's is centred."""
    model = mujoco.MjModel.from_binary_path(str(cheetah))
    scene = MujocoScene.load(cheetah)
    shapes = {shape.entity: shape.archetype for shape in scene.shapes()}
    geom = 4  # bshin's
    assert model.body(model.geom_bodyid[geom]).name == "bshin"
    capsule = shapes["/world/bshin/g4"]
    assert isinstance(capsule, rr.Capsules3D)
    assert capsule.translations is not None and capsule.lengths is not None
    start = np.array(capsule.translations.as_arrow_array().to_pylist()[0])
    length = capsule.lengths.as_arrow_array().to_pylist()[0]
    axis = np.zeros(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), model.geom_quat[geom])
    np.testing.assert_allclose(start + axis * length / 2, model.geom_pos[geom], atol=1e-6)
    assert length == pytest.approx(2 * model.geom_size[geom][1])


def test_every_kind_of_geometry_that_can_be_drawn_is(tmp_path: Path) -> None:
    geoms = ["sphere", "capsule", "cylinder", "box", "ellipsoid"]
    parts = "".join(f'<geom type="{kind}" size="0.1 0.2 0.3"/>' for kind in geoms)
    world = f'<geom type="plane" size="1 1 1"/><body><joint/>{parts}</body>'
    xml = f"<mujoco><worldbody>{world}</worldbody></mujoco>"
    scene = MujocoScene(mujoco.MjModel.from_xml_string(xml))
    floor, *shapes = scene.shapes()
    assert floor.entity == "/world/ground"
    assert [type(shape.archetype).__name__ for shape in shapes] == [
        "Ellipsoids3D", "Capsules3D", "Cylinders3D", "Boxes3D", "Ellipsoids3D",
    ]  # fmt: skip
    assert shapes[0].entity == "/world/body1/g1"  # a body without a name


def test_the_views_frame_goes_with_the_robot_on_the_ground_and_does_not_turn(cheetah: Path) -> None:
    poses = MujocoScene.load(cheetah).poses([qpos(1), qpos(2)])
    frame, torso = poses["/world/follow"], poses["/world/torso"]
    assert frame.quaternion is None
    np.testing.assert_array_equal(frame.translation[:, :2], torso.translation[:, :2])
    assert not frame.translation[:, 2].any()
    point = PointScene().poses([np.array([3.0]), np.array([4.0, 5.0, 6.0])])
    np.testing.assert_array_equal(point["/world/follow"].translation, [[3, 0, 0], [4, 5, 0]])


def test_the_camera_stands_back_by_the_robots_size() -> None:
    """A rod 2 m long, centred 3 m up: 1.1 m across to each side, as far as its rounded ends reach."""
    rod = '<body pos="0 0 3"><freejoint/><geom type="capsule" size="0.1 1" euler="0 90 0"/></body>'
    floor = '<geom type="plane" size="40 40 1"/>'
    xml = f"<mujoco><worldbody>{floor}{rod}</worldbody></mujoco>"
    camera = MujocoScene(mujoco.MjModel.from_xml_string(xml)).camera
    assert camera.eye == pytest.approx((0.15 * 2.2, -1.1 * 2.2, 3.0 + 0.25 * 2.2))
    assert camera.target == pytest.approx((0.0, 0.0, 2.4))


def test_a_body_with_a_name_of_ours_or_none_is_numbered() -> None:
    names = ['name="follow"', 'name="ground"', 'name="a b"', "", 'name="left_leg-2"']
    bodies = "".join(f'<body {name}><joint/><geom size="0.1"/></body>' for name in names)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    assert list(MujocoScene(model).poses([np.zeros(5)])) == [
        "/world/body1", "/world/body2", "/world/body3", "/world/body4", "/world/left_leg-2", "/world/follow",
    ]  # fmt: skip


@pytest.mark.parametrize(("hz", "every"), [(20, 1), (60, 1), (100, 2), (125, 2), (200, 4), (1000, 20)])
def test_about_fifty_pictures_a_second_are_enough(hz: int, every: int) -> None:
    assert drawn_every(msgspec.structs.replace(SPEC, tick_ns=1_000_000_000 // hz)) == every


def test_only_every_nth_tick_is_drawn(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    stage.spec.put(msgspec.structs.replace(SPEC, tick_ns=5 * MS))
    stage.steps([make_step(seq, due_ns=T0 + seq * 5 * MS) for seq in range(50)], last=True)
    stage.service.close()
    assert reading.columns(stage.path, "/world/point", reading.TRANSLATION)[0].tolist() == list(
        range(0, 50, 4)
    )
    assert len(reading.columns(stage.path, "/env/reward")[0]) == 50


def test_positions_of_another_size_are_left_out() -> None:
    steps = [make_step(seq, position=bytes(8 * seq)) for seq in range(6)] + [make_step(6, position=bytes(12))]
    assert [len(step.position) // 8 for step in drawn(steps, 1, PointScene())] == [1, 2, 3]


@pytest.mark.parametrize("content", [None, b"no model"])
def test_without_a_model_there_is_no_3d_and_everything_else(tmp_path: Path, content: bytes | None) -> None:
    stage = set_stage(tmp_path)
    if content is not None:
        stage.run_dir.world_path.write_bytes(content)
    stage.spec.put(msgspec.structs.replace(SPEC, scene="mujoco"))
    stage.steps([make_step(seq) for seq in range(10)], last=True)
    stage.service.close()
    (event,) = stage.events()
    assert event.level == "WARN"
    assert event.text.startswith("no 3-D view: ")
    assert len(reading.columns(stage.path, "/env/reward")[0]) == 10
