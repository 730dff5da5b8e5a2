"""Open an asset or a simulation in Blender and check that mesh and points stand where they were written.

Blender (the `bpy` module) wants an environment of its own, without this package:

    python3.11 -m venv blender && blender/bin/pip install bpy==5.0.1
    .venv/bin/python tests/benchmarks/open_in_blender.py --expect FILE.usdc        # writes FILE.npz
    blender/bin/python tests/benchmarks/open_in_blender.py FILE.usdc FILE.npz      # compares, frame by frame

Prints the largest difference in metres per object and frame. Exits 1 where an object or an attribute is
missing or a position differs by more than 1e-6 m.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

TOLERANCE = 1e-6


def expect(path: Path) -> None:
    """Write what this package reads from `path` to an .npz beside it."""
    from gdpro_sim.asset import Asset, kind
    from gdpro_sim.io.usd import SimulationReader

    arrays: dict[str, np.ndarray] = {}
    if kind(path) == "asset":
        asset = Asset.load(path)
        rest = asset.gaussians.gaussians()
        frames = [(0, [(asset.gaussians.vertices.numpy(), rest)])]
    else:
        frames = [
            (frame.index, [(body.vertices, body.gaussians) for body in frame.bodies])
            for frame in SimulationReader(path)
        ]
    for index, bodies in frames:
        for k, (vertices, g) in enumerate(bodies):
            arrays[f"{index}.{k}.mesh"] = vertices
            arrays[f"{index}.{k}.points"] = g.means.numpy()
            arrays[f"{index}.{k}.rot"] = g.quats.numpy()
            arrays[f"{index}.{k}.scale"] = g.scales.numpy()
    np.savez(path.with_suffix(".npz"), frames=np.array([i for i, _ in frames]), **arrays)
    print(f"wrote {path.with_suffix('.npz')}: {len(frames)} frames, {len(frames[0][1])} bodies")


def attribute(data: object, name: str, field: str, width: int) -> np.ndarray | None:
    layer = data.attributes.get(name)  # type: ignore[attr-defined]
    if layer is None:
        return None
    values = np.empty(len(layer.data) * width, np.float32)
    layer.data.foreach_get(field, values)
    return values.reshape(-1, width)


def compare(path: Path, expected: Path | None) -> int:
    """Open `path` in Blender; 0 where everything stands where `expected` says."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=str(path.resolve()))
    objects = {kind: [o for o in bpy.data.objects if o.type == kind] for kind in ("MESH", "POINTCLOUD")}
    for kind in objects:
        # Imported in body order; Blender appends .001 and so on to repeated names.
        objects[kind].sort(key=lambda o: o.name)
        print(f"{kind}: {[o.name for o in objects[kind]]}")
    scene = bpy.context.scene
    print(f"Blender {bpy.app.version_string}, frames {scene.frame_start}-{scene.frame_end}")
    if not (objects["MESH"] and objects["POINTCLOUD"]):
        print("FAILED: a mesh or a point cloud is missing")
        return 1
    if expected is None:
        return 0
    data = np.load(expected, allow_pickle=False)
    worst, failed = 0.0, False
    for frame in data["frames"]:
        scene.frame_set(int(frame))
        graph = bpy.context.evaluated_depsgraph_get()
        line = []
        for kind, key in (("MESH", "mesh"), ("POINTCLOUD", "points")):
            for k, thing in enumerate(objects[kind]):
                shown = thing.evaluated_get(graph)
                found = attribute(shown.data, "position", "vector", 3)
                wanted = data[f"{frame}.{k}.{key}"]
                assert found is not None
                turn = np.array(shown.matrix_world)
                found = found @ turn[:3, :3].T.astype(np.float32) + turn[:3, 3].astype(np.float32)
                if found.shape != wanted.shape:
                    print(f"FAILED: {thing.name} has {found.shape}, expected {wanted.shape}")
                    return 1
                difference = float(np.abs(found - wanted).max())
                worst = max(worst, difference)
                line.append(f"{thing.name} {difference:.1e} m")
                if kind == "POINTCLOUD":
                    for name, field, width in (("rot", "value", 4), ("scale", "vector", 3)):
                        values = attribute(shown.data, name, field, width)
                        if values is None:
                            failed = True
                            line.append(f"{name} MISSING")
                            continue
                        line.append(f"{name} {float(np.abs(values - data[f'{frame}.{k}.{name}']).max()):.1e}")
        print(f"frame {frame}: " + ", ".join(line))
    print(f"largest position difference over {len(data['frames'])} frames: {worst:.1e} m")
    return 1 if failed or worst > TOLERANCE else 0


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] == "--expect":
        expect(Path(sys.argv[2]))
    elif len(sys.argv) in (2, 3):
        sys.exit(compare(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) == 3 else None))
    else:
        sys.exit(__doc__)
