"""Animation without physics, recorded like a simulation: a motion carries an asset's Gaussians."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.asset import Asset
from gdpro_sim.errors import MeshError, RequestError
from gdpro_sim.files import prepare_folder
from gdpro_sim.io.record import Progress, Recording, record
from gdpro_sim.simulation.animation import VertexSource, open_motion, save_motion
from gdpro_sim.simulation.animation.solver import LOOKS
from gdpro_sim.simulation.scene import Scene, check_scene


def animate(
    asset: Asset | str | Path,
    output: str | Path,
    *,
    motion: VertexSource | str | Path | None = None,
    fps: int | None = None,
    start: float | None = None,
    end: float | None = None,
    loop: int = 1,
    speed: float = 1.0,
    clip: str | None = None,
    up: str = "auto",
    scale: float | None = None,
    budget: int = 50_000,
    color: str | None = None,
    texture: str | Path | None = None,
    tolerance: float | None = None,
    camera: dict[str, Any] | None = None,
    device: str = "auto",
    fresh: bool = False,
    on_progress: Progress | None = None,
) -> Recording:
    """Let a motion move an asset, and write into the folder `output` what a simulation writes.

    asset:      an asset, an asset file, a mesh file, or the motion's own file or folder, whose mesh is then
                bound to about `budget` Gaussians in its rest pose
    motion:     as in `gdpro_sim.simulation.animation.open_motion`, or any `VertexSource`; default: `asset`
    fps:        frames per second that are written, and the rate of numbered meshes; default: the motion's
    start, end: s, the part of the motion that is shown
    loop:       how many times
    speed:      seconds of the motion per second
    clip:       name or number of a glTF file's animation
    up, scale, color, texture: of the motion's mesh, as in `gdpro_sim.meshing.load.load_mesh`
    tolerance:  how far the asset may lie off the motion's mesh, as a share of its size; default 0.02
    camera:     as in a scene

    >>> gdpro_sim.animate("fox.glb", "out/fox")  # doctest: +SKIP
    >>> gdpro_sim.animate("duck.usdc", "out/duck", motion="waddle/", fps=24)  # doctest: +SKIP

    Raises RequestError (also SceneError, MeshError, AssetError) before anything runs; a run that was stopped
    continues when it is asked for again, as `gdpro_sim.record` does.
    """
    scene = animation_scene(
        asset, output, motion=motion, fps=fps, start=start, end=end, loop=loop, speed=speed, clip=clip,
        up=up, scale=scale, budget=budget, color=color, texture=texture, tolerance=tolerance, camera=camera,
    )  # fmt: skip
    return record(scene, output, device=device, fresh=fresh, on_progress=on_progress)


def animation_scene(
    asset: Asset | str | Path,
    output: str | Path,
    *,
    motion: VertexSource | str | Path | None = None,
    fps: int | None = None,
    start: float | None = None,
    end: float | None = None,
    loop: int = 1,
    speed: float = 1.0,
    clip: str | None = None,
    up: str = "auto",
    scale: float | None = None,
    budget: int = 50_000,
    color: str | None = None,
    texture: str | Path | None = None,
    tolerance: float | None = None,
    camera: dict[str, Any] | None = None,
) -> Scene:
    """The scene that `animate` records. What is no file yet is written into the folder `output`."""
    if loop < 1:
        raise RequestError(f"loop must be >= 1, got {loop}")
    if not (math.isfinite(speed) and speed > 0.0):
        raise RequestError(f"speed must be a finite number > 0, got {speed}")
    if motion is None and isinstance(asset, Asset):
        raise RequestError("an asset does not move by itself: give a motion")
    path = _file(motion if motion is not None else asset, output, "motion.npz")
    moved = path if motion is None else _file(asset, output, "still.usdc")
    numbered = float(fps) if fps is not None and path.is_dir() else None
    try:
        opened = open_motion(path, fps=numbered, clip=clip, up=up, scale=scale)
    except MeshError as error:
        hint = "" if motion is not None else "; or give the motion in a file of its own"
        raise MeshError(f"{error}{hint}") from error
    first = opened.begin if start is None else start
    last = opened.end if end is None else end
    if not opened.begin - 1e-9 <= first < last <= opened.end + 1e-9:
        raise RequestError(
            f"{first:g} to {last:g} s is not within {path.name}, which lasts from {opened.begin:g} to "
            f"{opened.end:g} s"
        )
    rate = fps if fps is not None else max(1, round(opened.fps))
    floor = min(float(opened.vertices(t)[:, 2].min()) for t in np.linspace(first, last, LOOKS))
    moving = {"file": str(path), "clip": clip, "fps": numbered, "start": first, "end": last, "speed": speed}
    moving |= {"loop": loop > 1, "up": up, "scale": scale}
    if tolerance is not None:
        moving["tolerance"] = tolerance
    body = {"name": _name(moved), "asset": str(moved), "anchor": "origin", "budget": budget}
    body |= {"color": color, "texture": None if texture is None else str(Path(texture).resolve())}
    return check_scene(
        {
            "name": path.stem,
            "description": f"{path.name} moves {moved.name}, without physics.",
            "bodies": [{**body, "animation": moving}],
            "ground": {"height": floor},
            "gravity": (0.0, 0.0, 0.0),
            "fps": rate,
            "duration": loop * (last - first) / speed,
            "camera": camera or {},
            "solver": {"kind": "animation"},
        },
        path.name,
    )


def _file(given: Asset | VertexSource | str | Path, output: str | Path, name: str) -> Path:
    """The absolute path of what was given; an object is written into the output folder first."""
    if isinstance(given, str | Path):
        path = Path(given).expanduser().resolve()
        if not path.exists():
            raise RequestError(f"{given}: no such file or folder")
        return path
    path = prepare_folder(output, name) / name
    if isinstance(given, Asset):
        given.save(path)
    else:
        save_motion(path, given)
    return path.resolve()


def _name(path: Path) -> str:
    safe = "".join(ch if ch.isascii() and ch.isalnum() else "_" for ch in path.stem)
    return safe if safe[:1].isalpha() else f"body_{safe}"


__all__ = ["animate", "animation_scene"]
