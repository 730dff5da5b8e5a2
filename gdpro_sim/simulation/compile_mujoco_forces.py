"""Springs, attachments and loads of a scene that MuJoCo simulates.

They act on points of its bodies (`MujocoWorld.firsts`): the tet vertices of soft ones, the centre and surface
of rigid ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TypeGuard

import numpy as np

from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.compile_forces import (
    Faced,
    Tets,
    compile_pressures,
    compile_pushes,
    compile_spring,
    compile_ties,
    compile_winds,
    joined,
    tied,
)
from gdpro_sim.simulation.conditions import Load, Springs
from gdpro_sim.simulation.forces import Attachment
from gdpro_sim.simulation.model import Body, Model
from gdpro_sim.simulation.mujoco_model import FRAME, MujocoWorld, RigidBody, SoftBody, Tie
from gdpro_sim.simulation.regions import Region
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody

WORLD = -1
"""The group of what stands fixed."""


class Solid(Faced):
    """A rigid body: its points are those of its surface; `centre` is the number of its centre of mass."""

    def __init__(self, scene: Scene, body: Body, item: RigidBody, first: int) -> None:
        super().__init__(scene, body.name, item.surface, first + FRAME, placement=body.placement)
        self.centre = first
        self.faces = body.gaussians.faces.cpu().numpy()
        self._frame = item.points[:FRAME]

    def carried(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axes = np.linalg.inv((self._frame[1:] - self._frame[0]).T)
        along = (points - self._frame[0]) @ axes.T
        weights = np.column_stack([1.0 - along.sum(axis=1), along])
        return np.tile(np.arange(self.centre, self.centre + 4, dtype=np.int32), (len(points), 1)), weights


class _Whole(Solid):
    """The same for loads: the whole body is its centre of mass."""

    def select(self, region: Region, key: str) -> np.ndarray:
        if not region.chosen:
            return np.array([self.centre - self.first])
        return super().select(region, key)


def apply_loads(scene: Scene, model: Model) -> Model:
    """`model` with the springs, attachments and loads of its scene.

    Raises SceneError for what selects nothing, does nothing, or holds rigid bodies twice.
    """
    world = model.mujoco
    assert world is not None
    placed: dict[str, Faced] = {}
    loads: list[Load] = []
    for described, body, item, first in zip(
        scene.bodies, model.bodies, world.bodies, world.firsts(), strict=False
    ):
        if isinstance(item, RigidBody):
            placed[body.name] = Solid(scene, body, item, first)
            loads += _on_rigid(described, _Whole(scene, body, item, first), item)
        else:
            tets = Tets(scene, body, model)
            placed[body.name] = tets
            loads += compile_pushes(described, tets, item.masses)
            loads += compile_pressures(described, tets)
    loads += compile_winds(scene, placed)
    springs = [compile_spring(scene, k, spring, placed) for k, spring in enumerate(scene.springs)]
    welds, bodies, ties = _attachments(scene, world, placed)
    springs += ties
    return replace(
        model,
        loads=tuple(loads),
        springs=joined(springs) if springs else None,
        mujoco=replace(world, bodies=bodies, welds=welds),
    )


def _on_rigid(body: SceneBody, item: Solid, rigid: RigidBody) -> Iterator[Load]:
    """Loads; parts of a surface share the body's mass by area."""
    for k, push in enumerate(body.impulses):
        if push.velocity is not None and push.chosen:
            raise SceneError(
                f"{item.where}.impulses[{k}].velocity: a part of a rigid body cannot gain a velocity alone; "
                "give an `impulse`, or no region"
            )
    for k, load in enumerate(body.pressures):
        if not load.chosen:
            raise SceneError(
                f"{item.where}.pressures[{k}]: on the whole of a rigid body it does nothing; give a region"
            )
    corners = item.points[item.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = np.bincount(item.faces.ravel(), weights=np.repeat(area, 3), minlength=len(item.points))
    mass = np.concatenate([rigid.mass * share / share.sum(), np.full(FRAME, rigid.mass)])
    yield from compile_pushes(body, item, mass)  # the centre is number -FRAME from the first
    yield from compile_pressures(body, item)


def _attachments(
    scene: Scene, world: MujocoWorld, placed: dict[str, Faced]
) -> tuple[tuple[tuple[int, int], ...], tuple[RigidBody | SoftBody, ...], list[Springs]]:
    """Rigid bodies held to each other, bodies with what ties them to rigid ones, and springs for the rest."""
    numbers = {body.name: k for k, body in enumerate(scene.bodies)}
    bodies = list(world.bodies)
    welds: list[tuple[int, int]] = []
    springs: list[Springs] = []
    held = _Groups([WORLD if _fixed(body) else k for k, body in enumerate(bodies)])
    for k, ties, a, b, ids in tied(scene, placed):
        where = f"{scene.name}: attachments[{k}]"
        one, two = numbers[a.name], numbers[b.name]
        first, second = bodies[one], bodies[two]
        stiff = ties.stiffness is None
        if stiff and ties.damping > 0.0:
            raise SceneError(f"{where}.damping: needs a `stiffness` in MuJoCo")
        if stiff and isinstance(first, RigidBody) and isinstance(second, RigidBody):
            if not held.join(one, two):
                raise SceneError(
                    f"{where}: {a.name!r} and {b.name!r} are held to each other already, directly or by way "
                    "of others or the world: this closes a loop; leave it out, or give it a `stiffness`"
                )
            welds.append((one, two))
        elif stiff and isinstance(second, RigidBody) and _full(first):
            bodies[one] = _carried(where, first, Tie(ids.astype(np.int32), two))
        elif stiff and isinstance(first, RigidBody) and _full(second):
            raise SceneError(
                f"{where}.bodies: {a.name!r} is rigid and {b.name!r} is soft: name the soft body first, its "
                "vertices are tied; or give a `stiffness`"
            )
        else:
            springs.append(compile_ties(ties, a, b, ids, _stiffness(ties, len(ids))))
    return tuple(welds), tuple(bodies), springs


def _carried(where: str, body: SoftBody, tie: Tie) -> SoftBody:
    """The soft body with one more tie. Raises SceneError for vertices that are held already."""
    taken = np.zeros(len(body.vertices), bool) if body.pinned is None else body.pinned.copy()
    for other in body.ties:
        taken[other.vertices] = True
    if taken[tie.vertices].any():
        vertex = int(tie.vertices[taken[tie.vertices]][0])
        place = np.round(body.vertices[vertex], 3).tolist()
        raise SceneError(
            f"{where}: vertex {vertex} of {body.name!r} at {place} m is pinned or tied already; choose a "
            "region, or a smaller `distance`"
        )
    return replace(body, ties=(*body.ties, tie))


def _stiffness(ties: Attachment, count: int) -> np.ndarray:
    """[count] N/m of each; without any the solver makes them as stiff as its steps bear."""
    return np.full(count, np.inf if ties.stiffness is None else ties.stiffness / count)


def _full(body: RigidBody | SoftBody) -> TypeGuard[SoftBody]:
    return isinstance(body, SoftBody) and body.reduction == "full"


def _fixed(body: RigidBody | SoftBody) -> bool:
    return isinstance(body, RigidBody) and body.joint.kind == "fixed"


class _Groups:
    """Bodies that are held to each other, by number."""

    def __init__(self, groups: list[int]) -> None:
        self._groups = groups

    def join(self, a: int, b: int) -> bool:
        """Whether they were apart; they are together from now on."""
        one, two = self._groups[a], self._groups[b]
        if one == two:
            return False
        self._groups = [min(one, two) if g in (one, two) else g for g in self._groups]
        return True


__all__ = ["apply_loads"]
