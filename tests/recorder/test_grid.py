"""A world on a board is drawn where its cells are."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import rerun as rr

from recorder import reading
from recorder.grid import GridScene
from rtcore.board import Board, board_path, save_board
from tests.recorder.stage import SPEC, make_step, set_stage

# S . G
# R R .    column 0 is left, row 0 is far
BOARD = Board(rows=["S.G", "RR."])
GRID = msgspec.structs.replace(SPEC, scene="grid", env_id="cliffworld", native_period_ns=0)


def position(*numbers: float) -> bytes:
    return np.array(numbers, "<f8").tobytes()


def centers(scene: GridScene, entity: str) -> list[list[float]]:
    (boxes,) = [shape.archetype for shape in scene.shapes() if shape.entity == entity]
    assert isinstance(boxes, rr.Boxes3D) and boxes.centers is not None
    return [[round(c, 3) for c in center] for center in boxes.centers.as_arrow_array().to_pylist()]


def test_cells_are_where_the_board_has_them() -> None:
    scene = GridScene(BOARD)
    assert centers(scene, "/world/board/start") == [[0, 0, -0.05]]
    assert centers(scene, "/world/board/cells") == [[1, 0, -0.05], [2, -1, -0.05]]
    assert centers(scene, "/world/board/goals") == [[2, 0, -0.05]]
    assert centers(scene, "/world/board/restarts") == [[0, -1, -0.3], [1, -1, -0.3]]  # a step down


def test_a_kind_of_cell_that_the_board_has_not_is_no_entity() -> None:
    entities = [shape.entity for shape in GridScene(Board(rows=["S."])).shapes()]
    assert "/world/board/goals" not in entities and "/world/board/restarts" not in entities


def test_the_agent_stands_on_its_cell_and_the_post_in_the_goal_that_pays() -> None:
    poses = GridScene(BOARD).poses([np.array([2.0, 1.0, 2.0, 0.0]), np.array([1.0, 1.0, 0.0, 0.0])])
    # 0.3 above the cell, and 0.25 lower on a cell that sends back; the post is 0.9 high
    np.testing.assert_allclose(poses["/world/agent"].translation, [[2, -1, 0.3], [1, -1, 0.05]], atol=1e-6)
    np.testing.assert_allclose(poses["/world/goal"].translation, [[2, 0, 0.45], [0, 0, 0.45]], atol=1e-6)


def test_the_whole_board_is_before_the_camera() -> None:
    """Its frame stays in the middle of the board, so the eye stays where it is."""
    scene = GridScene(Board(rows=["." * 12] * 3))
    (frame,) = [shape.archetype for shape in scene.shapes() if shape.entity == "/world/follow"]
    assert isinstance(frame, rr.Transform3D) and frame.translation is not None
    assert frame.translation.as_arrow_array().to_pylist() == [[5.5, -1.0, 0.0]]
    assert "/world/follow" not in scene.poses([np.zeros(4)])
    assert scene.camera.eye[1] < -1.5 and scene.camera.eye[2] > 0  # before its near edge, and above


def test_in_the_file(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    save_board(BOARD, stage.run_dir.world_path)
    stage.spec.put(GRID)
    cells = [(seq % 3, seq % 2) for seq in range(20)]
    stage.steps([make_step(i, position=position(x, y, 2, 0)) for i, (x, y) in enumerate(cells)], last=True)
    stage.service.close()
    assert stage.events() == []
    ticks, places = reading.columns(stage.path, "/world/agent", reading.TRANSLATION)
    assert ticks.tolist() == list(range(20))
    np.testing.assert_allclose(places[:, :2], [(x, -y) for x, y in cells])
    assert "/world/board/restarts" in reading.entities(stage.path)


def test_a_position_that_is_no_pair_of_cells_is_left_out(tmp_path: Path) -> None:
    stage = set_stage(tmp_path)
    save_board(BOARD, stage.run_dir.world_path)
    stage.spec.put(GRID)
    sizes = [0, 1, 2, 4, 5]
    stage.steps([make_step(i, position=position(*[1.0] * n)) for i, n in enumerate(sizes)], last=True)
    stage.service.close()
    assert reading.columns(stage.path, "/world/agent", reading.TRANSLATION)[0].tolist() == [3]


@pytest.mark.parametrize("content", [None, b"no board"])
def test_without_a_board_there_is_no_3d_and_everything_else(tmp_path: Path, content: bytes | None) -> None:
    stage = set_stage(tmp_path)
    if content is not None:
        board_path(stage.run_dir.world_path).write_bytes(content)
    stage.spec.put(GRID)
    stage.steps([make_step(seq) for seq in range(10)], last=True)
    stage.service.close()
    (event,) = stage.events()
    assert event.level == "WARN"
    assert event.text.startswith("no 3-D view: world.json")
    assert len(reading.columns(stage.path, "/env/reward")[0]) == 10
