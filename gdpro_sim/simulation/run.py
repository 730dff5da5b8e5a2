"""Running a scene: one frame after another, as Gaussians and deformed meshes."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from gdpro_sim.asset import Asset
from gdpro_sim.device import resolve_device
from gdpro_sim.errors import SceneError, SolverError
from gdpro_sim.simulation.callbacks import with_code
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.compile import compile_scene, load_assets
from gdpro_sim.simulation.conditions import Motion, pose_at
from gdpro_sim.simulation.frame import BodyFrame, Frame
from gdpro_sim.simulation.model import Diagnostics, Model, Solver
from gdpro_sim.simulation.scene import Scene, load_scene

log = logging.getLogger(__name__)

OVERLAP = 0.05
"""Share of its size that a body may start inside a base without a warning."""


class Simulation:
    """A compiled scene and its solver; iterating yields every `Frame`, the initial one first.

    The figures of the last frame stand in `milliseconds` ("solve", "resplat").
    """

    def __init__(self, scene: Scene, assets: dict[str, Asset], *, device: str = "auto") -> None:
        self.scene = scene
        self.assets = assets
        self.device = resolve_device(device)
        self.model: Model = compile_scene(scene, assets, device=self.device)
        try:
            self.solver = solver_of(self.model)
        except SolverError as error:  # before the first step it is the scene that asks for what cannot be
            raise SceneError(f"{scene.name}: {error}") from error
        self.milliseconds: dict[str, float] = {"solve": 0.0, "resplat": 0.0}
        self._time = 0.0

    def __len__(self) -> int:
        return self.scene.frame_count

    def __iter__(self) -> Iterator[Frame]:
        self.solver.reset()
        for index in range(len(self)):
            self.advance(index)
            yield self.frame(index, self.surfaces(), self.solver.diagnostics(), self.colliders())

    def advance(self, index: int) -> None:
        """Bring the solver from frame `index - 1` to frame `index`; frame 0 is the initial state."""
        begin = time.perf_counter()
        if index == 1:
            self._tell_of_overlaps()
        if index > 0:
            self.solver.step(1.0 / self.scene.fps)
        self._time = index / self.scene.fps
        self.milliseconds["solve"] = 1e3 * (time.perf_counter() - begin)

    def _tell_of_overlaps(self) -> None:
        """Bodies that start inside a base are pushed out at once: they may fly, or be torn."""
        sizes = {body.name: float(np.ptp(body.surface, axis=0).max()) for body in self.model.bodies}
        for name, part, depth in getattr(self.solver, "overlaps", list)():
            if depth > OVERLAP * sizes[name]:
                log.warning(
                    "body %r starts %.2g m inside %r of the base, which pushes it out: move it, or the base",
                    name, depth, part,
                )  # fmt: skip

    def surfaces(self) -> list[np.ndarray]:
        """Deformed surface vertices of every body, [V, 3] float32 m."""
        return [self.solver.surface_positions(i) for i in range(len(self.model.bodies))]

    @property
    def obstacles(self) -> tuple[Collider, ...]:
        """What pictures show besides the bodies: the scene's colliders, then the parts of a base."""
        return (*self.model.colliders, *getattr(self.solver, "links", ()))

    def colliders(self) -> np.ndarray | None:
        """Where `obstacles` are that move freely, by a function or as parts of a base: `Frame.colliders`."""
        if self.model.particles is not None and any(item.mass is not None for item in self.model.colliders):
            from gdpro_sim.simulation.mpm import SolverMPM
            from gdpro_sim.simulation.mpm.boundaries import collider_poses

            assert isinstance(self.solver, SolverMPM)
            own = collider_poses(self.solver.boundaries, self.model, self.solver.time)
            return np.stack([np.column_stack(pose) for pose in own])
        links = getattr(self.solver, "links", ())
        motions = [item.motion for item in self.model.colliders]
        if not links and not any(isinstance(item, Motion) and item.function for item in motions):
            return None
        still = np.eye(3), np.zeros(3)
        own = [still if motion is None else pose_at(motion, self._time) for motion in motions]
        poses = [np.column_stack(pose) for pose in own]
        return np.stack([*poses, *(self.solver.link_poses() if links else ())])  # type: ignore[attr-defined]

    def frame(
        self,
        index: int,
        surfaces: list[np.ndarray],
        diagnostics: Diagnostics,
        colliders: np.ndarray | None = None,
    ) -> Frame:
        """Re-splat: the Gaussians of every body carried by its surface."""
        begin = time.perf_counter()
        bodies = tuple(
            BodyFrame(body.name, surface, body.gaussians.gaussians(torch.from_numpy(surface)))
            for body, surface in zip(self.model.bodies, surfaces, strict=True)
        )
        self.milliseconds["resplat"] = 1e3 * (time.perf_counter() - begin)
        return Frame(index, index / self.scene.fps, bodies, diagnostics, colliders)


def solver_of(model: Model) -> Solver:
    """The solver of a model: MPM where it has particles, MuJoCo where it has its bodies, all of them where it
    is coupled, none of them where motions move its bodies, else FEM.

    Raises SceneError or SolverError.
    """
    # Solvers are imported here: they compile kernels, which loading a scene should not.
    if model.coupling is not None:
        from gdpro_sim.simulation.coupled import SolverCoupled

        return SolverCoupled(model)
    if model.animation is not None:
        from gdpro_sim.simulation.animation.solver import SolverAnimation

        return SolverAnimation(model)
    if model.particles is not None:
        from gdpro_sim.simulation.mpm import SolverMPM

        return SolverMPM(model)
    if model.mujoco is not None:
        from gdpro_sim.simulation.mujoco import SolverMuJoCo

        return SolverMuJoCo(model)
    from gdpro_sim.simulation.fem import SolverFEM

    return SolverFEM(model)


def simulate(
    scene: Scene | str | Path,
    *,
    device: str = "auto",
    allow_code: bool = False,
    on_progress: Callable[[str], None] | None = None,
) -> Simulation:
    """Load and compile a scene; iterate the result to run it.

    scene:      a `Scene`, a YAML path, or the name of a shipped scene.
    allow_code: run the Python files that the scene names (`motion: {callback: …}`)

    Between frames the loop may look at everything, stop, and set what the scene's own Python functions read:
    a step asks them for times within it.
    Raises SceneError, MeshError, AssetError or DeviceError; iterating may raise SolverError.

        for frame in gdpro_sim.simulate("jelly_bunny"):
            print(frame.time, frame.bodies[0].gaussians.means.mean(0))
    """
    checked = scene if isinstance(scene, Scene) else load_scene(scene)
    checked = with_code(checked, allow_code)
    return Simulation(checked, load_assets(checked, on_progress=on_progress), device=device)


__all__ = ["Simulation", "simulate", "solver_of"]
