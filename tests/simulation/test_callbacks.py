"""Motion by Python functions: where it takes things, what must be allowed, and what is said when it fails."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gdpro_sim.asset import Asset
from gdpro_sim.cli import main
from gdpro_sim.errors import SceneError, SolverError
from gdpro_sim.io.record import record
from gdpro_sim.io.usd import SimulationReader
from gdpro_sim.io.views import render_file
from gdpro_sim.simulation.callbacks import with_code
from gdpro_sim.simulation.colliders import compile_collider
from gdpro_sim.simulation.compile import compile_scene
from gdpro_sim.simulation.conditions import Motion, pose_at
from gdpro_sim.simulation.forces import Pin
from gdpro_sim.simulation.run import solver_of
from gdpro_sim.simulation.scene import Scene, check_scene, load_scene
from tests.simulation.cubes import SIDE, cube_asset, write_cube

STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return cube_asset(tmp_path_factory.mktemp("cube"))


def wander(time: float) -> Any:
    return np.array([[1.0 + 0.5 * time * time, math.sin(time), 2.0], [0.0, 90.0 * time, 30.0]])


def motion_of(function: Any, start: float = 0.0) -> Motion:
    return Pin(side="top", motion=function).compiled(np.array([1.0, 2.0, 3.0]), start=start)


def test_a_function_moves_from_where_things_are() -> None:
    motion = motion_of(wander)
    for time in (0.0, 0.3, 1.7):
        rotation, shift = pose_at(motion, time)
        first, now = wander(0.0), wander(time)
        turn = Rotation.from_rotvec(now[1], degrees=True) * Rotation.from_rotvec(first[1], degrees=True).inv()
        np.testing.assert_allclose(rotation, turn.as_matrix(), atol=1e-12)
        moved = rotation @ [1.0, 2.0, 3.0] + shift
        np.testing.assert_allclose(moved, np.array([1.0, 2.0, 3.0]) + now[0] - first[0], atol=1e-12)
    np.testing.assert_allclose(pose_at(motion, 0.0)[0], np.eye(3), atol=1e-15)


def test_what_is_taken_hold_of_later_moves_from_then() -> None:
    motion = motion_of(wander, start=1.0)
    for time in (0.0, 0.5, 1.0):
        np.testing.assert_allclose(pose_at(motion, time)[1], 0.0, atol=1e-12)
    rotation, shift = pose_at(motion, 2.0)
    moved = rotation @ [1.0, 2.0, 3.0] + shift - [1.0, 2.0, 3.0]
    np.testing.assert_allclose(moved, wander(2.0)[0] - wander(1.0)[0], atol=1e-12)


@pytest.mark.parametrize("kind", ["fem", "mpm", "mujoco"])
def test_every_solver_follows_a_function(cube: Asset, kind: str) -> None:
    def move(time: float) -> Any:
        return (0.0, 0.3 * time * time, 0.0), (0.0, 0.0, 90.0 * time)

    options = {"kind": kind} | ({"grid_spacing": 0.04} if kind == "mpm" else {})
    body = {
        "name": "box", "asset": "cube.ply", "position": [0, 0, 1], "anchor": "center", "material": "jelly",
        "pins": {"side": "top", "fraction": 0.6, "motion": move},
        "mujoco": {"form": "full"} if kind == "mujoco" else None,
    }  # fmt: skip
    scene = check_scene({"bodies": body, "ground": None, "solver": options})
    solver = solver_of(compile_scene(scene, {"box": cube}))
    rest = solver.surface_positions(0)
    for _ in range(3):
        solver.step(0.05)
    turn = Rotation.from_euler("z", 90 * 0.15, degrees=True).as_matrix()
    expected = (rest - [0, 0, 1]) @ turn.T + [0, 0.3 * 0.15**2, 1]
    lid = rest[:, 2] > 1.0 + 0.49 * SIDE
    np.testing.assert_allclose(solver.surface_positions(0)[lid], expected[lid], atol=0.02 * SIDE)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            lambda t: STILL if t < 0.5 else 1 / (t - 0.5),
            r"at 0.5 s raised ZeroDivisionError: .*\(test_callbacks.py, line \d+\)",
        ),
        (
            lambda t: ((0, 0, math.nan if t else 0), (0, 0, 0)),
            r"at 0.5 s gave \(\(0, 0, nan\), .* finite num",
        ),
        (lambda t: (0, 0, 0), r"at 0 s gave \(0, 0, 0\); it must give a translation \(m\) and a rotation ve"),
        (lambda t: ((0, 0), (0, 0, 0)), "at 0 s gave"),
        (lambda t: None, r"at 0 s gave None; .*test_callbacks.py, line \d+"),
        (lambda t: "up", "at 0 s gave 'up'"),
    ],
)
def test_what_a_function_does_wrong_is_named(function: Any, message: str) -> None:
    with pytest.raises(SolverError, match=message) as caught:
        pose_at(motion_of(function), 0.5)
    assert "callback test_callbacks.py:<lambda>" in str(caught.value) and "\n" not in str(caught.value)


MOVES = """
import pathlib
pathlib.Path(__file__).with_name("was_run").touch()
SPEED = 2.0
def lift(time):
    return (0, 0, SPEED * time), (0, 0, 0)
number = 3
"""


def written(folder: Path, callback: str = "moves.py:lift", code: str = MOVES, **scene: Any) -> Scene:
    (folder / "moves.py").write_text(code)
    write_cube(folder / "cube.ply")
    plate = {"kind": "box", "size": [1, 1, 0.1], "position": [0, 0, 0.2], "motion": {"callback": callback}}
    body = {"asset": "cube.ply", "position": [0, 0, 0.3], "budget": 300, "mujoco": {"shape": "box"}}
    described = {
        "name": "s", "bodies": body, "colliders": plate, "solver": {"kind": "mujoco"}, "duration": 0.15,
        "fps": 20, "folder": folder, "camera": {"width": 64, "height": 48},
    }  # fmt: skip
    return check_scene(described | scene)


def test_code_runs_only_where_it_is_allowed(tmp_path: Path) -> None:
    scene = written(tmp_path)
    with pytest.raises(SceneError) as caught:
        with_code(scene, False)
    said = str(caught.value)
    assert "colliders[0].motion" in said and "moves.py" in said and "--allow-code" in said
    assert "\n" not in said and not (tmp_path / "was_run").exists()
    with pytest.raises(SceneError, match="was not loaded"):
        compile_collider(scene.colliders[0])
    allowed = with_code(scene, True)
    assert (tmp_path / "was_run").exists()
    motion = compile_collider(allowed.colliders[0]).motion
    assert isinstance(motion, Motion)
    np.testing.assert_allclose(pose_at(motion, 0.5)[1], [0, 0, 1])
    assert with_code(allowed, False) is allowed


@pytest.mark.parametrize(
    ("callback", "code", "message"),
    [
        ("moves.py:lft", MOVES, r"moves.py has no 'lft' \(did you mean 'lift'\?\)"),
        ("moves.py:swing", "x = 1", "moves.py has no 'swing'; functions: none"),
        ("moves.py:number", MOVES, "number in .*moves.py is 3, which is no function"),
        ("moves.txt:lift", MOVES, r"must be FILE.py:FUNCTION, got 'moves.txt:lift'"),
        ("moves.py", MOVES, r"must be FILE.py:FUNCTION, got 'moves.py'"),
        ("other.py:lift", MOVES, r"other.py: no such file"),
        ("moves.py:lift", "def lift(:\n", r"moves.py, line 1: SyntaxError"),
        ("moves.py:lift", "\n\nraise ValueError('no')", r"moves.py, line 3: ValueError: no"),
        ("moves.py:lift", "import sys\nsys.exit(0)", r"moves.py, line 2: SystemExit"),
    ],
)
def test_files_and_functions_that_cannot_be_had(
    tmp_path: Path, callback: str, code: str, message: str
) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        with_code(written(tmp_path, callback, code), True)
    assert "\n" not in str(caught.value) and "colliders[0].motion" in str(caught.value)


def test_the_command_line_names_the_flag(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    written(tmp_path)
    text = "bodies: {asset: cube.ply}\ncolliders: {kind: plane, motion: {callback: 'moves.py:lift'}}\n"
    (tmp_path / "s.yaml").write_text(text)
    monkeypatch.setattr(
        "sys.argv", ["gdpro", "simulate", str(tmp_path / "s.yaml"), "-o", str(tmp_path / "o")]
    )
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2 and "--allow-code" in capsys.readouterr().err
    assert not (tmp_path / "was_run").exists()
    with pytest.raises(SceneError, match=r"motion\[0\].calback: unknown key"):
        (tmp_path / "s.yaml").write_text(text.replace("callback", "calback"))
        load_scene(tmp_path / "s.yaml")


def test_a_failing_run_keeps_its_frames_and_a_changed_file_starts_anew(tmp_path: Path, caplog: Any) -> None:
    code = "def lift(t):\n    assert t < 0.06, 'too late'\n    return (0, 0, t), (0, 0, 0)\n"
    with pytest.raises(SolverError, match=r"moves.py:lift at 0.0\d+ s raised AssertionError: .*line 2\)"):
        record(written(tmp_path, code=code), tmp_path / "out", allow_code=True)
    assert len(list((tmp_path / "out/frames").glob("*.png"))) == 2
    assert len(SimulationReader(tmp_path / "out/simulation.usdc")) == 2
    again = code.replace("0.06", "9").replace("t), (0", "2 * t), (0")
    done = record(written(tmp_path, code=again), tmp_path / "out", allow_code=True)
    assert done.resumed_frames == 0 and "another scene" in caplog.text
    poses = [frame.colliders for frame in SimulationReader(done.simulation)]
    np.testing.assert_allclose([pose[0, 2, 3] for pose in poses if pose is not None], 0.1 * np.arange(4))
    (tmp_path / "moves.py").unlink()  # pictures are made again without it
    pictures = render_file(done.simulation, tmp_path / "again")
    for picture in pictures:
        assert picture.read_bytes() == (done.frames / picture.name).read_bytes()
