"""Rooms import only from rooms above them (the order of the pipeline), and the package imports lightly."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FLOORS: list[set[str]] = [
    {"errors", "files", "kernels", "crew", "device"},
    {"gaussians", "cameras", "binding", "materials"},
    {"splatting"},
    {"meshing", "asset"},
    {"generation", "simulation"},
    {"io"},
    {"cli"},
]
"""Top to bottom. Rooms on one floor may import each other only as WITHIN says."""

WITHIN = {
    ("files", "errors"),
    ("device", "errors"),
    ("device", "kernels"),
    ("device", "crew"),
    ("crew", "kernels"),
    ("binding", "gaussians"),
    ("asset", "meshing"),
}


def floor_of(room: str) -> int:
    for index, rooms in enumerate(FLOORS):
        if room in rooms:
            return index
    raise AssertionError(f"{room} stands on no floor: add it to FLOORS")


def imports_of(path: Path) -> set[str]:
    """Rooms of this package that a file imports, anywhere in it (TYPE_CHECKING blocks too)."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = node.module or ""
            names = [f"{module}.{alias.name}" for alias in node.names] if module == "gdpro_sim" else [module]
        found.update(n.split(".")[1] for n in names if n.startswith("gdpro_sim."))
    return found


def sources() -> list[tuple[str, Path]]:
    library = ROOT / "gdpro_sim"
    listed = [("kernels", p) for p in sorted((ROOT / "kernels").glob("*.py"))]
    for path in sorted(library.rglob("*.py")):
        if path != library / "__init__.py":
            listed.append((path.relative_to(library).parts[0].removesuffix(".py"), path))
    return listed


@pytest.mark.parametrize(("room", "path"), sources(), ids=lambda v: v.name if isinstance(v, Path) else v)
def test_rooms_import_upwards_only(room: str, path: Path) -> None:
    for other in imports_of(path) - {room, "__version__"}:
        if (room, other) in WITHIN:
            continue
        assert floor_of(other) < floor_of(room), f"{path}: {room} must not import {other}"


def test_kernels_know_only_warp() -> None:
    for path in (ROOT / "kernels").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                assert all(a.name in ("warp", "math", "platform") for a in node.names), path
            elif isinstance(node, ast.ImportFrom):
                allowed = ("gdpro_sim.kernels", "__future__", "typing")
                assert (node.module or "").startswith(allowed), (path, node.module)


def test_the_package_imports_without_a_backend() -> None:
    code = (
        "import sys, gdpro_sim; "
        "heavy = {'torch', 'warp', 'trimesh', 'pxr', 'mujoco'} & set(sys.modules); "
        "assert not heavy, heavy; assert 'Asset' in dir(gdpro_sim)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_resolves() -> None:
    import gdpro_sim

    for name in gdpro_sim.__all__:
        assert getattr(gdpro_sim, name) is not None


def test_every_package_folder_is_installed() -> None:
    import tomllib

    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {"gdpro_sim.kernels", "gdpro_sim.scenes"}
    for init in (ROOT / "gdpro_sim").rglob("__init__.py"):
        found.add(".".join(init.parent.relative_to(ROOT).parts))
    assert listed == found
