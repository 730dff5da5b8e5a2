"""What acts on the grid's velocities: ground, walls, obstacles, and what holds or drives particles.

Nodes in an obstacle, and those right outside, cannot move matter into it: it sticks, slips, or leaves and
rubs, see `gdpro_sim.kernels.mpm_boundary`. What is held back is the surface of the particles, half their
spacing from their middles. Substeps are short enough for what comes nearer to be seen before it touches.
Where obstacles overlap matter all the same, it is pushed out slowly. A limit: an obstacle thinner than two
cells may have too few nodes to keep matter out (the log says which).
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import warp as wp

from gdpro_sim.device import Launches
from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import mpm_boundary as kernels
from gdpro_sim.kernels import mpm_drivers, mpm_gaps
from gdpro_sim.kernels.colliders import signed_distances
from gdpro_sim.kernels.mpm_transfer import tile_width
from gdpro_sim.simulation.collider_shapes import KINDS as COLLIDER_KINDS
from gdpro_sim.simulation.collider_shapes import ColliderShape, placed
from gdpro_sim.simulation.colliders import ROOM, Collider, mesh_thickness
from gdpro_sim.simulation.conditions import FOREVER, Guide
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mpm.drivers import Holds, Loads, corners, top_speed
from gdpro_sim.simulation.mpm.grid import Grid
from gdpro_sim.simulation.mpm.rigid import RigidBodies, recentred

log = logging.getLogger(__name__)

KINDS = {"sticky": kernels.STICKY, "slip": kernels.SLIP, "separate": kernels.SEPARATE}

NODES_REACH = 1.5
"""From the middle of a block to its last node, in cells along each axis."""

PARTICLES_REACH = 3.0
"""From the middle of a block's particles to where the last may stray, in cells along each axis."""

SEEN = {"explicit": 0.4, "implicit": 1.75}
"""Gaps wider than that many cells are not looked at, and substeps close no wider ones; across the wider of
the two matter and obstacle share no nodes."""

AROUND = 2.1
"""Cells around what is seen that nodes know the distance of, to tell it between them."""

MARGIN = 1.0
"""Cells that a moving obstacle may go before the blocks near it are looked for again."""

THIN = 0.25
"""Share of a mesh's faces that may have too little behind them without a warning: ears, fins."""

COUPLINGS = 8
"""Most Newton iterations for the velocity of a rigid body among matter that slides, sticks or leaves."""


class Boundary(Protocol):
    """Changes velocities of nodes, or of particles, in every substep."""

    def plan(self, time: float, dt: float) -> None:
        """A step from `time` to `time` + `dt` s begins."""

    def speed(self) -> float:
        """Of the fastest thing that it moves through matter in this step, m/s."""

    def begin(self, time: float, h: float) -> None:
        """A substep from `time` to `time` + `h` s begins."""

    def apply(self, grid: Grid, h: float) -> None:
        """Change the velocities of `grid.values`, in place."""

    def drive(self, grid: Grid, h: float) -> None:
        """Change `grid.particles` after they have moved, in place."""

    def state(self) -> dict[str, wp.array]:
        """Arrays that change, to be saved with the solver's."""


class Obstacles:
    """The ground, the walls of the domain and all colliders of a model, those with a mass included.

    bodies: rigid bodies that matter moves
    guided: numbers of the obstacles that a `Guide` moves
    """

    def __init__(self, model: Model) -> None:
        assert model.particles is not None
        self.items, first = _obstacles(model)
        self._colliders = slice(first, first + len(model.colliders))
        self._walls = model.mpm.domain
        free = [c for c, item in enumerate(self.items) if item.mass is not None]
        for c in free:
            self.items[c] = recentred(self.items[c])
        self.bodies = RigidBodies([self.items[c] for c in free], model.gravity)
        self._body_of = {c: k for k, c in enumerate(free)}
        self.guided = [c for c, item in enumerate(self.items) if isinstance(item.motion, Guide)]
        self._moving = [c for c, item in enumerate(self.items) if item.motion is not None or c in free]
        self._timed = [c for c, item in enumerate(self.items) if (item.start, item.end) != (0.0, FOREVER)]
        self._planes = [c for c, item in enumerate(self.items) if item.kind == "plane"]
        self._shapes = [ColliderShape(_reaching(item), model.device) for item in self.items]
        self._structs = [shape.struct() for shape in self._shapes]
        self._host = np.zeros((len(self.items), kernels.COLUMNS))
        for c, item in enumerate(self.items):
            self._place(c, 0.0, 1.0)
            self._host[c, kernels.KIND] = KINDS[item.boundary]
            self._host[c, kernels.FRICTION] = -1.0 if item.friction is None else item.friction
        self._table: wp.array = wp.array(self._host, dtype=wp.float64, device=model.device)
        friction = np.array([m.friction for m in model.particles.materials], np.float32)
        self._friction: wp.array = wp.array(friction, dtype=float, device=model.device)
        self._radius = 0.5 * model.particles.spacing
        self._sees = SEEN[model.mpm.integrator]
        kinds = np.array([COLLIDER_KINDS[item.kind] for item in self.items], np.int32)
        self._kinds: wp.array = wp.array(kinds, dtype=int, device=model.device)
        share = np.bincount(model.particles.matter, model.particles.volumes, len(friction))
        self._usual_friction = float(share @ friction / share.sum())
        self._one_friction = bool(np.ptp(friction) == 0.0)
        self._fluid = any(material.model == "fluid" for material in model.particles.materials)
        self._listed: wp.array | None = None  # the blocks that are listed
        self._empty = True
        self._impulse: wp.array = wp.zeros((0, 6), dtype=wp.float64, device=model.device)
        self._taken: wp.array = wp.zeros((len(self.guided), 6), dtype=wp.float64, device="cpu")
        self._nothing: wp.array = wp.zeros(0, dtype=wp.vec4, device=model.device)
        self._travel = np.zeros(len(self.items))
        self._measured = False
        self._warned = False
        self._pairs: list[tuple[int, int]] = []
        around = model.particles.positions.astype(np.float64)
        self._corners = [_corners_of(item, around) for item in self.items]
        self._driven = 0.0
        cell = model.mpm.grid_spacing or 2.0 * model.particles.spacing
        for c in range(len(self.items))[self._colliders]:
            item = self.items[c]
            if item.boundary != "sticky" and item.start == 0.0 and c not in self.guided:
                _check_outside(model, item, self._structs[c], cell)

    def plan(self, time: float, dt: float) -> None:
        self._taken.zero_()
        self._driven = 0.0
        for c in self._moving:
            item = self.items[c]
            if item.motion is not None and item.start < time + dt and time < item.end:
                self._driven = max(self._driven, top_speed(item.motion, self._corners[c], time, dt))

    def speed(self) -> float:
        fastest = self._driven
        for c, k in self._body_of.items():
            lever = float(np.linalg.norm(self._corners[c] - self.items[c].position, axis=1).max())
            spin = float(np.linalg.norm(self.bodies.angular_velocities[k]))
            fastest = max(fastest, float(np.linalg.norm(self.bodies.velocities[k])) + lever * spin)
        return fastest

    def begin(self, time: float, h: float) -> None:
        for c in self._moving:
            if c not in self._body_of:
                self._place(c, time, h)
        for c in self._timed:
            here = self.items[c].start <= time < self.items[c].end
            self._host[c, kernels.KIND] = KINDS[self.items[c].boundary] if here else kernels.ABSENT
        if self._body_of:
            self.bodies.begin(h)
            for c, k in self._body_of.items():
                self._host[c, kernels.ORIGIN : kernels.LINEAR] = self.bodies.frame(k)
                self._host[c, kernels.LINEAR : kernels.KIND] = self.bodies.motion(k)
        if self._moving or self._timed:
            self._table.assign(self._host)
        self._measured = False

    def apply(self, grid: Grid, h: float) -> None:
        self.meet(grid, h, self._nothing)

    def meet(self, grid: Grid, h: float, left: wp.array) -> None:
        """`apply`; the last obstacle that a node meets takes `left`, m/s of each node, from it besides."""
        if self._listed is not grid.blocks or (self._travel > MARGIN * grid.spacing).any():
            self._list(grid)
        if self._empty:
            return
        if not self._measured:
            for c in self._moving:
                self._measure(grid, c)
            self._find_gaps(grid)
            self._measured = True
        for c, k in self._body_of.items():
            self._couple(grid, c, k, h)
        self._impulse.zero_()
        count = 64 if grid.device == "cpu" else 1
        grid.launch(
            kernels.meet_obstacles,
            len(self._near) * 64 // count,
            [
                count, self._near, self._starts, self._order, self._owner, self._field, self._met,
                self._gap, self._rubbing, self._table, float(h), wp.float64(grid.spacing), grid.blocks, left,
            ],
            [grid.values, self._impulse],
            minimum=16 * 64 // count,
        )  # fmt: skip

    def fill(self, grid: Grid) -> None:
        """Give nodes the mass that they would have if fluids went on inside obstacles: for their density."""
        if self._empty or not self._fluid:
            return
        inputs = [
            grid.width, self._near, self._starts, self._order, self._owner, self._field, self._table,
            grid.spacing,
        ]  # fmt: skip
        grid.launch(kernels.fill_obstacles, 64 * len(self._near), inputs, [grid.values], minimum=4096)

    def drive(self, grid: Grid, h: float) -> None:
        if not self._empty:
            self._take()
        for c in self._moving:
            linear = np.linalg.norm(self._host[c, kernels.LINEAR : kernels.SPIN])
            spin = np.linalg.norm(self._host[c, kernels.SPIN : kernels.KIND])
            self._travel[c] += h * (linear + spin * self._lever[c])
        if self._body_of:
            self.bodies.move(h, [self._plane(c) for c in self._planes if self._is_there(c)])
        if self._walls is not None:
            low, high = self._walls
            count = 1024 if grid.device == "cpu" else 1
            inputs = [count, len(grid.ids), wp.vec3(*low), wp.vec3(*high)]
            items = -(-len(grid.ids) // count)
            grid.launch(mpm_drivers.keep_inside, items, inputs, [grid.particles], minimum=8192 // count)

    def state(self) -> dict[str, wp.array]:
        found = {"bodies": self.bodies.state} if self._body_of else {}
        return found | {"impulses": self._taken} if self.guided else found

    def impulses(self) -> np.ndarray:
        """[C, 6] N s and N m s about the world's origin that the model's colliders took from matter.

        In the last step; 0 for those that are not guided.
        """
        found = np.zeros((len(self.items), 6))
        found[self.guided] = self._taken.numpy()
        return found[self._colliders]

    def _take(self) -> None:
        """Give obstacles what they took from matter when it last met them."""
        if not self.guided and not self._body_of:
            return
        given = self._impulse.numpy()
        for c, k in self._body_of.items():
            begin, end = self._pairs[c]
            self.bodies.take(k, _in_order(given[begin:end]))
        for taken, c in zip(self._taken.numpy(), self.guided, strict=True):
            begin, end = self._pairs[c]
            impulse = _in_order(given[begin:end])
            impulse[3:] += np.cross(self._host[c, kernels.ORIGIN : kernels.ROTATION], impulse[:3])
            taken += impulse

    def poses(self) -> list[tuple[np.ndarray, np.ndarray] | None]:
        """For each of the model's colliders: its rigid motion since the start, where it has a mass."""
        return [
            self.bodies.pose(self._body_of[c]) if c in self._body_of else None
            for c in range(len(self.items))[self._colliders]
        ]

    def _is_there(self, c: int) -> bool:
        return bool(self._host[c, kernels.KIND] != kernels.ABSENT)

    def _plane(self, c: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float | None]:
        """Point, normal, velocity of the point, friction."""
        row = self._host[c]
        normal = row[kernels.ROTATION : kernels.LINEAR].reshape(3, 3)[:, 2]
        return row[:3], normal, row[kernels.LINEAR : kernels.SPIN], self.items[c].friction

    def _place(self, c: int, time: float, h: float) -> None:
        """Where an obstacle is when a substep begins, and how it gets to where it is when it ends."""
        row = self._host[c]
        rotation, origin = placed(self.items[c], time)
        row[kernels.ORIGIN : kernels.ROTATION] = origin
        row[kernels.ROTATION : kernels.LINEAR] = rotation.ravel()
        if self.items[c].motion is not None:
            after, end = placed(self.items[c], time + h)
            row[kernels.LINEAR : kernels.SPIN] = (end - origin) / h
            row[kernels.SPIN : kernels.KIND] = ((after @ rotation.T - np.eye(3)) / h).ravel()

    def _list(self, grid: Grid) -> None:
        """Find the blocks near each obstacle, and how far their nodes are from it."""
        self._warn(grid.spacing)
        self._listed = grid.blocks
        self._travel[:] = 0.0
        middles = grid.spacing * (4.0 * grid.blocks.numpy() + NODES_REACH)
        found = [self._near_blocks(grid, c, grid.blocks, NODES_REACH) for c in range(len(self.items))]
        tiles = [self._near_blocks(grid, c, grid.coords, PARTICLES_REACH) for c in range(len(self.items))]
        origins = self._host[:, kernels.ORIGIN : kernels.ROTATION]
        self._lever = np.array([np.linalg.norm(middles - o, axis=1).max() for o in origins])
        self._empty = not any(len(ids) for ids in found)
        if self._empty:
            return
        ends = np.cumsum([0, *(len(ids) for ids in found)])
        self._pairs = list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True))
        block = np.concatenate(found).astype(np.int32)
        owner = np.repeat(np.arange(len(found), dtype=np.int32), [len(ids) for ids in found])
        order = np.lexsort((owner, block)).astype(np.int32)
        near, starts = np.unique(block[order], return_index=True)
        where = np.full(grid.count, -1, np.int32)
        where[near] = np.arange(len(near), dtype=np.int32)
        self._near = grid.set("obstacles.near", near, int)
        self._starts = grid.set("obstacles.starts", np.append(starts, len(block)).astype(np.int32), int)
        self._order = grid.set("obstacles.order", order, int)
        self._owner = grid.set("obstacles.owner", owner, int)
        self._block = grid.set("obstacles.block", block, int)
        self._where = grid.set("obstacles.where", where, int)
        self._field = grid.array("obstacles.field", 64 * len(block), wp.vec4)
        self._rubbing = grid.array("obstacles.friction", 64 * len(near), float)
        if self._body_of or self.guided:
            self._impulse = _table(grid, "obstacles.impulse", len(block), 6)
            self._sums = {
                c: _table(grid, f"obstacles.coupling.{c}", len(found[c]), kernels.SUMS)
                for c in self._body_of
                if len(found[c])
            }
        self._met = grid.array("obstacles.met", len(block), int)
        self._gap = grid.array("obstacles.gap", 64 * len(block), float)
        self._link(grid, found, tiles)
        for c in range(len(self.items)):
            self._measure(grid, c)
        self._measured = False
        if self._one_friction:
            self._rubbing.fill_(self._usual_friction)
        else:
            self._mix_friction(grid)

    def _near_blocks(self, grid: Grid, c: int, blocks: wp.array, reach: float) -> np.ndarray:
        """Numbers of the blocks that an obstacle may have to do with before the next sort."""
        # A block's particles lie from half a node after its first to half a node after its last.
        middle = NODES_REACH if reach == NODES_REACH else NODES_REACH + 0.5 * (grid.width - 2)
        distance = grid.array("obstacles.distance", len(blocks), wp.float64)
        inputs = [c, wp.float64(middle), self._structs[c], self._table, wp.float64(grid.spacing), blocks]
        grid.launch(mpm_gaps.measure_blocks, len(blocks), inputs, [distance])
        cells = reach * math.sqrt(3.0) + self._sees + AROUND
        if self.items[c].kind == "plane":
            normal = self._host[c, kernels.ROTATION : kernels.LINEAR].reshape(3, 3)[:, 2]
            beyond = self._sees + self._radius / grid.spacing
            cells = reach * float(np.abs(normal).sum())
            outside = 0.5 * grid.width if self._fluid else float(mpm_gaps.OUTSIDE)
            cells += outside if reach == NODES_REACH else beyond
        if c in self._moving:
            cells += MARGIN
        return np.flatnonzero(distance.numpy() <= cells * grid.spacing)

    def _link(self, grid: Grid, found: list[np.ndarray], tiles: list[np.ndarray]) -> None:
        """Tell pairs of the tiles that reach them, and tiles of the pairs around them."""
        neighbors = grid.neighbors.numpy().reshape(-1, 27)
        sources = grid.sources.numpy().reshape(-1, 27)
        around, reached, first = [], [], 0
        for (begin, end), nodes, blocks in zip(self._pairs, found, tiles, strict=True):
            pair = np.full(grid.count, -1, np.int32)
            pair[nodes] = np.arange(begin, end, dtype=np.int32)
            tile = np.full(grid.occupied + 1, -1, np.int32)  # the last for sources that are none
            tile[blocks] = np.arange(first, first + len(blocks), dtype=np.int32)
            around.append(pair[neighbors[blocks]])
            reached.append(tile[sources[nodes]])
            first += len(blocks)
        owner = np.repeat(np.arange(len(tiles), dtype=np.int32), [len(ids) for ids in tiles])
        self._tile = grid.set("obstacles.tile", np.concatenate(reached).ravel(), int)
        self._tile_count = len(owner)
        if not self._tile_count:
            return
        self._tile_owner = grid.set("obstacles.tile_owner", owner, int)
        self._tile_block = grid.set("obstacles.tile_block", np.concatenate(tiles).astype(np.int32), int)
        self._around = grid.set("obstacles.around", np.concatenate(around).ravel(), int)
        self._seen = grid.array("obstacles.seen", len(owner), int)
        self._tiles = grid.array("obstacles.tiles", len(owner) * tile_width(grid.width) ** 3, float)

    def _find_gaps(self, grid: Grid) -> None:
        """How far the matter at each node is from obstacles."""
        if not self._tile_count:
            self._met.zero_()
            return
        inputs = [
            grid.width, grid.spacing, self._radius, self._sees * grid.spacing, self._tile_owner,
            self._tile_block, self._around, self._kinds, self._table, self._field, grid.starts,
            grid.coords, grid.particles,
        ]  # fmt: skip
        grid.launch(mpm_gaps.find_gaps, self._tile_count, inputs, [self._seen, self._tiles], minimum=4)
        inputs = [grid.width, grid.spacing, self._tile, self._seen, self._tiles, self._field]
        grid.launch(mpm_gaps.gather_gaps, len(self._owner), inputs, [self._met, self._gap], minimum=16)

    def _measure(self, grid: Grid, c: int) -> None:
        """Signed distance of the nodes near an obstacle."""
        begin, end = self._pairs[c]
        inputs = [c, begin, self._structs[c], self._table, wp.float64(grid.spacing), grid.blocks, self._block]
        grid.launch(mpm_gaps.measure_nodes, 64 * (end - begin), inputs, [self._field])

    def _mix_friction(self, grid: Grid) -> None:
        """Friction of the matter at each node: the mean over its particles, by mass."""
        sums = grid.array("obstacles.sums", 64 * len(self._near), wp.vec4)
        sums.zero_()
        inputs = [
            grid.width, grid.spacing, self._usual_friction, self._near, grid.blocks, grid.sources,
            grid.starts, self._friction, grid.matter, grid.particles,
        ]  # fmt: skip
        grid.launch(mpm_drivers.mix_friction, len(self._near), inputs, [sums, self._rubbing], minimum=4)

    def _couple(self, grid: Grid, c: int, k: int, h: float) -> None:
        """Find the velocity that a rigid body and the matter that it is in have when they have met.

        Newton's method: the body's momentum after is what it had plus what nodes give it, which depends on
        its velocity after. Without it a body lighter than the nodes around it would be thrown about.
        """
        begin, end = self._pairs[c]
        if begin == end:
            return
        sums = self._sums[c]
        count = 64 if grid.device == "cpu" else 1
        for _ in range(COUPLINGS):
            sums.zero_()
            inputs = [
                count, c, begin, self._where, self._block, self._field, self._met, self._gap,
                self._rubbing, self._table, float(h), wp.float64(grid.spacing), grid.blocks, grid.values,
            ]  # fmt: skip
            items = (end - begin) * 64 // count
            grid.launch(kernels.sum_coupling, items, inputs, [sums], minimum=16 * 64 // count)
            total = _in_order(sums.numpy())
            moved = self.bodies.guess(k, total[:36].reshape(6, 6), total[36:])
            self._host[c, kernels.LINEAR : kernels.KIND] = self.bodies.motion(k)
            self._table.assign(self._host)
            if not moved:
                break

    def _warn(self, spacing: float) -> None:
        """Say which obstacles are too thin to keep matter out, and which pass through each other."""
        if self._warned:
            return
        self._warned = True
        solid = [item.name for item in self.items if item.kind != "plane"]
        if self._body_of and len(solid) > 1:
            log.warning(
                "colliders with a mass meet matter and planes, but pass through each other and other "
                "colliders (%s): for more, make them rigid bodies of a scene with `solver: {kind: coupled}`",
                ", ".join(solid),
            )
        for item in self.items:
            thickness = 2.0 * item.room / ROOM
            if item.kind == "plane" or item.heights is not None:  # as deep as need be
                continue
            if item.vertices is not None and item.faces is not None:
                thickness = mesh_thickness(item.vertices, item.faces, THIN)
            if thickness < 2.0 * spacing:
                log.warning(
                    "collider %r is %.3g m thick%s, less than two cells of %.3g m: matter may pass through; "
                    "make it thicker, or cells smaller",
                    item.name,
                    thickness,
                    "" if item.vertices is None else " or less in a quarter of its surface",
                    spacing,
                )


def boundaries(model: Model) -> tuple[Boundary, ...]:
    """All of a model's. Raises SolverError for loads that need a surface."""
    found: list[Boundary] = []
    obstacles = Obstacles(model)
    if obstacles.items:
        found.append(obstacles)
    if model.holds:
        found.append(Holds(model))
    if model.loads:
        found.append(Loads(model))
    return tuple(found)


def collider_poses(
    found: tuple[Boundary, ...], model: Model, time: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rigid motion of each of a model's colliders since the start: x = R X + t of what started at X.

    Those with a mass stand where the boundaries `found` have brought them, others where `time` in s has.
    """
    poses: list[tuple[np.ndarray, np.ndarray]] = []
    for collider in model.colliders:
        rotation, origin = placed(collider, time)
        turn = rotation @ collider.rotation.T
        poses.append((turn, origin - turn @ collider.position))
    for boundary in found:
        if isinstance(boundary, Obstacles):
            poses = [free or pose for free, pose in zip(boundary.poses(), poses, strict=True)]
    return poses


def _obstacles(model: Model) -> tuple[list[Collider], int]:
    """The ground, the colliders, the walls of the domain; and the number of the first collider."""
    found = []
    if model.ground is not None:
        found.append(replace(Collider.floor(model.ground.height), boundary=model.ground.boundary))
    first = len(found)
    found += model.colliders
    if model.mpm.domain is not None:
        low, high = (np.asarray(corner, np.float64) for corner in model.mpm.domain)
        if not (low < high).all():
            raise SolverError(f"the domain's upper corner {high.tolist()} must lie above {low.tolist()} m")
        outside = _outside(model, low, high)
        if outside:
            raise SolverError(
                f"{outside} particles start outside the domain {low.tolist()} to {high.tolist()} m"
            )
        for axis in range(3):
            for corner, sign in ((low, 1.0), (high, -1.0)):
                turn = np.roll(np.eye(3), axis + 1, axis=0)
                turn[:, 2] *= sign
                turn[:, 1] *= sign
                found.append(Collider("wall", "plane", position=corner, rotation=turn, friction=0.0))
    return found, first


def _check_outside(model: Model, item: Collider, shape: Any, cell: float) -> None:
    """Raise SolverError for matter that starts deeper inside a collider than a cell of `cell` m.

    What sticks is left alone: it may hold matter that is inside.
    """
    assert model.particles is not None
    points: wp.array = wp.array(
        model.particles.positions.astype(np.float64), dtype=wp.vec3d, device=model.device
    )
    distance: wp.array = wp.zeros(len(points), dtype=wp.float64, device=model.device)
    normal: wp.array = wp.zeros(len(points), dtype=wp.vec3d, device=model.device)
    Launches(model.device)(signed_distances, len(points), [shape, points], [distance, normal], minimum=4096)
    depth = -distance.numpy()
    deepest = int(np.argmax(depth))
    if depth[deepest] > cell:
        names = [b.name for b in model.bodies if b.particle_range[0] <= deepest < b.particle_range[1]]
        body = f"body {names[0]!r}" if names else f"particle {deepest}"
        raise SolverError(
            f"{body} starts {depth[deepest]:.3g} m inside collider {item.name!r}, more than a cell of "
            f"{cell:.3g} m; move one of them, or let the collider hold what is in it (`boundary: sticky`)"
        )


def _outside(model: Model, low: np.ndarray, high: np.ndarray) -> int:
    assert model.particles is not None
    x = model.particles.positions
    return int(((x < low.astype(np.float32)) | (x > high.astype(np.float32))).any(axis=1).sum())


def _reaching(collider: Collider) -> Collider:
    """A mesh whose distance is known everywhere: nodes may lie deep inside."""
    if collider.vertices is None:
        return collider
    return replace(collider, size=(1e3 * float(np.linalg.norm(np.ptp(collider.vertices, axis=0))), 0.0, 0.0))


def _corners_of(collider: Collider, points: np.ndarray) -> np.ndarray:
    """[8, 3] m, of a box around a collider at the start; of a plane, what lies around `points` [N, 3]."""
    a, b, c = collider.size
    far = float(np.linalg.norm(points - collider.position, axis=1).max())
    half = {
        "plane": (far, far, far),
        "box": (a, b, c),
        "sphere": (a, a, a),
        "capsule": (a, a, a + b),
        "cylinder": (a, a, b),
    }
    own = collider.vertices
    box = corners(np.array([half[collider.kind]]) * [[-1.0], [1.0]] if own is None else own)
    found: np.ndarray = collider.position + box @ collider.rotation.T
    return found


def _table(grid: Grid, name: str, rows: int, columns: int) -> wp.array:
    """[rows, columns] float64, from the grid's memory."""
    return grid.array(name, rows * columns, wp.float64).reshape((rows, columns))


def _in_order(rows: np.ndarray) -> Any:
    """Sum of rows, one after the other."""
    return np.cumsum(rows, axis=0)[-1] if len(rows) else np.zeros(rows.shape[1])


__all__ = ["Boundary", "Obstacles", "boundaries", "collider_poses"]
