"""Laws of MPM particles against float64 references: stress, yield surfaces, flow, damage, damping."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gdpro_sim.device import launch_chunked, set_thread_count, thread_count
from gdpro_sim.kernels import mpm_energy, mpm_laws, particles
from gdpro_sim.materials import FLOW_LAWS, LAWS, Material
from gdpro_sim.simulation.mpm.matter import Matter, sound_speed
from tests.conditions import needs_gpu
from tests.reference import mpm_laws as reference

BASE = {"young": 1.0e5, "poisson": 0.3, "density": 1000.0}
ELASTIC = {law: Material(model=law, **BASE) for law in LAWS if law != "linear"}
FLOWING = {
    "von_mises": Material(yield_stress=2.0e3, **BASE),
    "hardening": Material(yield_stress=2.0e3, hardening=5.0e4, **BASE),
    "sand": Material(model="drucker_prager", friction_angle=33.0, **BASE),
    "wet_sand": Material(model="drucker_prager", friction_angle=33.0, cohesion=400.0, **BASE),
    "snow": Material(model="snow", **BASE),
    "bingham": Material(model="herschel_bulkley", yield_stress=1.0e3, viscosity=8.0, **BASE),
    "thinning": Material(
        model="herschel_bulkley", yield_stress=300.0, viscosity=200.0, flow_index=0.4, **BASE
    ),
    "thickening": Material(
        model="herschel_bulkley", yield_stress=300.0, viscosity=2.0, flow_index=1.7, **BASE
    ),
    "fluid": Material(model="fluid", bulk_modulus=2.0e5, viscosity=3.0, density=1000.0),
}
TEARING = {
    f"torn_{law}": Material(model=law, tensile_strength=3.0e3, fracture_energy=2.0, **BASE) for law in ELASTIC
} | {"torn_metal": Material(yield_stress=5.0e3, tensile_strength=3.0e3, **BASE)}
ALL = ELASTIC | FLOWING | TEARING
every_material = pytest.mark.parametrize("name", ALL)
VOLUME = 1.0e-6


@dataclass
class Batch:
    """Particles of one material: what stands in their rows, float64."""

    F: np.ndarray
    C: np.ndarray
    velocity: np.ndarray
    internal: np.ndarray  # [4, N]
    tau: np.ndarray
    speed: np.ndarray
    energy: np.ndarray


def rows_of(F: np.ndarray, C: np.ndarray, velocity: np.ndarray, internal: np.ndarray) -> np.ndarray:
    table = np.zeros((int(particles.ROWS), len(F)), np.float32)
    high = F.astype(np.float32)
    with np.errstate(invalid="ignore"):
        low = F - high
    for row, values in (
        (particles.DEFORMATION, high),
        (particles.DEFORMATION_LOW, low),
        (particles.AFFINE, C),
    ):
        table[int(row) : int(row) + 9] = values.reshape(-1, 9).T
    table[int(particles.VELOCITY) : int(particles.VELOCITY) + 3] = velocity.T
    table[int(particles.INTERNAL) : int(particles.INTERNAL) + 4] = internal
    table[int(particles.VOLUME)] = VOLUME
    return table


def update(
    materials: Material | tuple[Material, ...],
    F: np.ndarray,
    C: np.ndarray | None = None,
    h: float = 0.0,
    *,
    velocity: np.ndarray | None = None,
    internal: np.ndarray | None = None,
    matter: np.ndarray | None = None,
    device: str = "cpu",
) -> Batch:
    """`update_stress` of particles with those trial gradients, and their energy."""
    n = len(F)
    table = Matter(materials if isinstance(materials, tuple) else (materials,), device).table
    numbers = np.zeros(n, np.int32) if matter is None else matter.astype(np.int32)
    zeros = np.zeros((n, 3))
    rows = rows_of(
        F,
        np.zeros((n, 3, 3)) if C is None else C,
        zeros if velocity is None else velocity,
        np.zeros((4, n)) if internal is None else internal,
    )
    kinds = wp.array(numbers, dtype=wp.int32, device=device)
    array = wp.array(rows, dtype=wp.float32, device=device)
    energy = wp.zeros(n, dtype=wp.float64, device=device)
    groups = mpm_laws.groups(n, device)
    launch_chunked(mpm_laws.update_stress, groups, [h, kinds, table], [array], device=device, minimum=1)
    launch_chunked(mpm_energy.elastic_energy, n, [kinds, table, array], [energy], device=device)
    out = array.numpy().astype(np.float64)

    def take(row: int, count: int) -> np.ndarray:
        return out[int(row) : int(row) + count]

    stress = take(particles.STRESS, 6)[[0, 3, 4, 3, 1, 5, 4, 5, 2]].T.reshape(n, 3, 3) / VOLUME
    deformation = take(particles.DEFORMATION, 9) + take(particles.DEFORMATION_LOW, 9)
    return Batch(
        deformation.T.reshape(n, 3, 3),
        take(particles.AFFINE, 9).T.reshape(n, 3, 3),
        take(particles.VELOCITY, 3).T,
        take(particles.INTERNAL, 4),
        stress,
        take(particles.SPEED, 1)[0],
        energy.numpy(),
    )


def rotations(count: int, seed: int = 0) -> np.ndarray:
    return Rotation.random(count, random_state=seed).as_matrix()


def gradients(count: int, size: float, seed: int = 0) -> np.ndarray:
    """Random stretches of about 1 +- size, rotated on both sides."""
    random = np.random.default_rng(seed)
    stretch = np.exp(size * random.standard_normal((count, 3)))
    return rotations(count, seed) * stretch[:, None, :] @ rotations(count, seed + 1)


def rates(count: int, size: float, seed: int = 5) -> np.ndarray:
    return size * np.random.default_rng(seed).standard_normal((count, 3, 3))


def initial_internal(material: Material, count: int, seed: int = 3) -> np.ndarray:
    """Some history that the law can have had."""
    random = np.random.default_rng(seed)
    internal = np.zeros((4, count))
    sizes = {"stvk_hencky": 0.05, "herschel_bulkley": 0.05, "drucker_prager": 0.03}
    internal[0] = sizes.get(material.model, 0.0) * random.random(count)
    if material.model in ("snow", "fluid"):
        internal[0] = 0.04 * random.standard_normal(count)
    if material.tensile_strength is not None:
        internal[1] = np.maximum(random.standard_normal(count), 0.0)
    return internal.astype(np.float32).astype(np.float64)


def test_laws_have_the_numbers_of_the_kernels() -> None:
    assert [int(getattr(mpm_laws, law.upper())) for law in FLOW_LAWS] == [5, 6, 7, 8]
    for law in (*LAWS, *FLOW_LAWS):
        assert Material.model_construct(model=law).law == (*LAWS, *FLOW_LAWS).index(law)


@every_material
@pytest.mark.parametrize("size", [1e-6, 1e-3, 0.05, 0.4])
def test_particles_answer_as_the_reference(name: str, size: float) -> None:
    material, n, h = ALL[name], 77, 2.0e-3
    F, C, internal = gradients(n, size), rates(n, 20 * size), initial_internal(ALL[name], 77)
    batch = update(material, F, C, h, internal=internal)
    for i in range(n):
        expected = reference.answer(
            material,
            F[i],
            C[i].astype(np.float32).astype(np.float64),
            h,
            memory=internal[0, i],
            passed=internal[1, i],
            volume=VOLUME,
        )
        scale = np.abs(expected.tau).max() + np.abs(np.log(np.linalg.svd(F[i])[1])).max() * material.young
        assert np.abs(batch.tau[i] - expected.tau).max() <= 3e-6 * scale
        assert np.abs(batch.F[i] - expected.F).max() <= 5e-6 * min(1.0, 10 * size + 0.1)
        remembered = batch.internal[0, i] + batch.internal[3, i]
        assert remembered == pytest.approx(expected.memory, rel=2e-6, abs=2e-7)
        assert batch.internal[1, i] == pytest.approx(expected.passed, rel=1e-5, abs=1e-5)
        assert batch.internal[2, i] == pytest.approx(expected.damage, abs=1e-5)


@pytest.mark.parametrize("name", ELASTIC)
@pytest.mark.parametrize("size", [1e-3, 0.3])
def test_stress_is_the_gradient_of_the_energy(name: str, size: float) -> None:
    """d Psi((1 + A) F) = tau : A for any small A."""
    material, F = ELASTIC[name], gradients(20, size)
    batch = update(material, F)
    step = 1e-2 * size
    random = np.random.default_rng(1)
    for _ in range(4):
        A = random.standard_normal((3, 3))
        A /= np.linalg.norm(A)
        up, down = (update(material, F + sign * step * A @ F).energy for sign in (1.0, -1.0))
        slope = (up - down) / (2 * step * VOLUME)
        exact = np.einsum("nij,ij->n", batch.tau, A)
        assert np.abs(slope - exact).max() <= 1e-4 * np.abs(batch.tau).max()


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("size", [1e-9, 1e-6])
def test_tiny_strains_give_hookes_stress(name: str, size: float) -> None:
    """Also far below what float32 can tell from one, and in matter that has turned."""
    material = ALL[name]
    if material.model in FLOW_LAWS and material.model != "herschel_bulkley":
        pytest.skip("its stress is no function of F alone, or limited from the start")
    lam, mu = material.lame
    E = size * rates(20, 1.0)
    E = (E + E.transpose(0, 2, 1)) / 2
    hooke = 2 * mu * E + lam * np.trace(E, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    scale = np.abs(hooke).max()
    assert np.abs(update(material, np.eye(3) + E).tau - hooke).max() <= (1e-6 + 10 * size) * scale
    R = rotations(20, 4)
    R = np.linalg.svd(R.astype(np.float32).astype(np.float64))
    R = R.U @ R.Vh
    turned = update(material, (np.eye(3) + E) @ R).tau
    # The two rows keep 14 digits.
    assert np.abs(turned - hooke).max() <= (1e-6 + 10 * size + 2e-14 / size) * scale


@every_material
def test_turning_a_particle_turns_its_stress_alone(name: str) -> None:
    material, n, h = ALL[name], 40, 1.0e-3
    F, C, internal = gradients(n, 0.1), rates(n, 3.0), initial_internal(ALL[name], 40)
    R = rotations(n, 9)
    turned = update(material, R @ F, R @ C @ R.transpose(0, 2, 1), h, internal=internal)
    batch = update(material, F, C, h, internal=internal)
    scale = np.abs(batch.tau).max()
    assert np.abs(turned.tau - R @ batch.tau @ R.transpose(0, 2, 1)).max() <= 1e-5 * scale
    if material.model != "fluid":
        assert np.abs(turned.F - R @ batch.F).max() <= 2e-6
    assert turned.internal[:3] == pytest.approx(batch.internal[:3], abs=1e-5)
    assert turned.energy == pytest.approx(batch.energy, rel=1e-4, abs=1e-6 * batch.energy.max())


@pytest.mark.parametrize("name", ["von_mises", "hardening", "bingham", "thinning"])
def test_plastic_flow_keeps_volume(name: str) -> None:
    F = gradients(200, 0.3)
    batch = update(FLOWING[name], F, h=1e-2)
    assert np.abs(batch.F - F).max() > 0.1
    assert np.linalg.det(batch.F) == pytest.approx(np.linalg.det(F), rel=3e-6)


def equivalent(tau: np.ndarray) -> np.ndarray:
    dev = tau - np.trace(tau, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return math.sqrt(1.5) * np.linalg.norm(dev, axis=(1, 2))


def test_von_mises_stress_stays_at_its_limit() -> None:
    F = gradients(200, 0.3)
    for name in ("von_mises", "hardening"):
        material = FLOWING[name]
        batch = update(material, F)
        assert material.yield_stress is not None
        limit = material.yield_stress + material.hardening * batch.internal[0]
        assert (equivalent(batch.tau) <= limit * (1 + 2e-5)).all()
        again = update(material, batch.F, internal=batch.internal)
        assert np.abs(again.tau - batch.tau).max() <= 2e-5 * np.abs(batch.tau).max()


def test_sand_stays_in_its_cone() -> None:
    """|dev tau| <= alpha (-tr tau) with Mohr-Coulomb's angle in triaxial compression, and no tension."""
    material = FLOWING["sand"]
    assert material.friction_angle is not None
    sine = math.sin(math.radians(material.friction_angle))
    batch = update(material, gradients(300, 0.2))
    pressure = -np.trace(batch.tau, axis1=1, axis2=2) / 3
    assert (pressure >= -1e-3).all()
    limit = 6 * sine / (3 - sine) * pressure
    assert (equivalent(batch.tau) <= limit * (1 + 1e-4) + 1e-2).all()
    # Axial compression under side pressure: sin(angle) = (s1 - s3) / (s1 + s3).
    F = np.diag(np.exp([-0.2, 0.05, 0.05]))[None]
    axial, side = np.diag(update(material, F).tau[0])[:2]
    assert (axial - side) / (axial + side) == pytest.approx(sine, rel=1e-4)


def test_sand_gives_volume_back_before_it_resists() -> None:
    """Opened by 10 % and closed again it is as it was; without the correction it would be packed hard."""
    material = FLOWING["sand"]
    internal, F = np.zeros((4, 1)), np.eye(3)[None]
    for trace in (0.06, 0.04, -0.05, -0.049):
        batch = update(material, math.exp(trace / 3) * F, internal=internal)
        assert np.abs(batch.tau).max() <= 1e-3
        F, internal = batch.F, batch.internal
    batch = update(material, math.exp(-0.011 / 3) * F, internal=internal)
    lam, mu = material.lame
    assert batch.tau[0] == pytest.approx((lam + 2 / 3 * mu) * -0.01 * np.eye(3), rel=1e-3, abs=1e-2)
    assert batch.internal[0] == pytest.approx(0.0, abs=1e-6)


def test_wet_sand_holds_tension_until_it_has_opened() -> None:
    material = FLOWING["wet_sand"]
    assert material.friction_angle is not None
    tension = material.cohesion / math.tan(math.radians(material.friction_angle))
    internal, F, held = np.zeros((4, 1)), np.eye(3)[None], []
    for _ in range(60):
        batch = update(material, math.exp(0.001) * F, internal=internal)
        held.append(np.trace(batch.tau[0]) / 3)
        F, internal = batch.F, batch.internal
    assert max(held) == pytest.approx(tension, rel=0.2)
    assert held[-1] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("name", ["bingham", "thinning", "thickening"])
@pytest.mark.parametrize("h", [1e-5, 1e-3])
def test_paste_in_steady_shear_has_the_stress_of_its_rate(name: str, h: float) -> None:
    """stress = yield / sqrt(3) + k rate^n in simple shear, for any substep."""
    material = FLOWING[name]
    assert material.yield_stress is not None
    for rate in (3.0, 50.0):
        C = np.zeros((1, 3, 3))
        C[0, 0, 1] = rate
        expected = material.yield_stress / math.sqrt(3) + material.viscosity * rate**material.flow_index
        # Start near the answer: shear stress mu gamma.
        F, internal = np.eye(3)[None].copy(), np.zeros((4, 1))
        F[0, 0, 1] = expected / material.lame[1]
        batch = None
        for _ in range(40 if h > 1e-4 else 400):
            batch = update(material, F + h * C @ F, C, h, internal=internal)
            F, internal = batch.F, batch.internal
        assert batch is not None
        assert batch.tau[0, 0, 1] == pytest.approx(expected, rel=0.03)


def test_snow_hardens_as_it_is_packed() -> None:
    material = FLOWING["snow"]
    lam, mu = material.lame
    internal, F, stiffness = np.zeros((4, 1)), np.eye(3)[None], []
    for _ in range(15):
        batch = update(material, 0.99 * F, internal=internal)
        stretches = np.linalg.svd(batch.F[0])[1]
        assert stretches.min() >= 1 - material.critical_compression - 1e-6
        stiffness.append(-np.trace(batch.tau[0]) / 3)
        F, internal = batch.F, batch.internal
    packed = float(internal[0, 0])
    assert 1 + packed == pytest.approx(0.99**45 / np.prod(stretches), rel=1e-4)
    s, J = stretches[0], np.prod(stretches)
    expected = -(2 * mu * s * (s - 1) + lam * J * (J - 1)) * math.exp(-material.snow_hardening * packed)
    assert stiffness[-1] == pytest.approx(expected, rel=1e-4)
    assert (np.diff(stiffness) > 0).all()


def test_fluid_resists_volume_alone() -> None:
    material = FLOWING["fluid"]
    assert material.bulk_modulus is not None
    n, h = 30, 1e-3
    C = rates(n, 5.0)
    batch = update(material, np.eye(3) + h * C, C, h)
    J = 1 + batch.internal[0] + batch.internal[3]
    assert pytest.approx(np.linalg.det(np.eye(3) + h * C), rel=1e-6) == J
    assert np.array_equal(batch.F, np.broadcast_to(np.eye(3), (n, 3, 3)))
    pressure = -np.trace(batch.tau, axis1=1, axis2=2) / 3 / J
    expected = np.maximum(material.bulk_modulus / 7 * (J**-7.0 - 1), 0.0)
    assert pressure == pytest.approx(expected, rel=1e-4, abs=1e-6 * material.bulk_modulus)
    # Its energy is the work of that pressure.
    less, more = (update(material, np.eye(3)[None], internal=np.full((4, 1), d) * [[1], [0], [0], [0]])
                  for d in (-0.0301, -0.0299))  # fmt: skip
    slope = (less.energy - more.energy)[0] / VOLUME / 2e-4
    assert slope == pytest.approx(material.bulk_modulus / 7 * (0.97**-7 - 1), rel=1e-3)


def test_slow_changes_of_a_fluid_are_not_lost() -> None:
    """A million substeps that each change J by a hundredth of float32's resolution."""
    material = FLOWING["fluid"]
    C = -2e-3 * np.eye(3)[None]
    internal = np.zeros((4, 1))
    internal[0] = -0.02
    table, kinds = Matter((material,), "cpu").table, wp.zeros(1, dtype=wp.int32)
    array = wp.array(rows_of(np.eye(3)[None], C, np.zeros((1, 3)), internal), dtype=wp.float32)
    for _ in range(2000):
        wp.launch(mpm_laws.update_stress, dim=1, inputs=[0, 1e-8, kinds, table, array], device="cpu")
    out = array.numpy().astype(np.float64)[int(particles.INTERNAL) : int(particles.INTERNAL) + 4, 0]
    assert out[0] + out[3] - internal[0, 0].astype(np.float32) == pytest.approx(
        -0.98 * 3 * 2e-3 * 2e-5, rel=1e-3
    )


def test_the_volume_of_a_fluid_follows_the_grid() -> None:
    """Packed 1.25 times: J falls from 1 towards 0.8 + 0.02, at 5 per second.

    At 0.8 times it rises towards 1.25 at 100 per second, half as fast where the density changes by a quarter
    over a cell, and towards less, as the air of a surface is near; not at all where it changes by half.
    """
    material = FLOWING["fluid"]
    table, kinds = Matter((material,), "cpu").table, wp.zeros(4, dtype=wp.int32)
    zeros = np.zeros((4, 3, 3))
    rows = rows_of(np.broadcast_to(np.eye(3), (4, 3, 3)), zeros, zeros[:, 0], np.zeros((4, 4)))
    rows[int(particles.DENSITY)] = [1250.0, 800.0, 800.0, 800.0]
    rows[int(particles.SLOPE)] = [0.0, 0.0, 250.0, 500.0]
    array = wp.array(rows, dtype=wp.float32)
    for _ in range(10):
        wp.launch(mpm_laws.update_stress, dim=1, inputs=[0, 1e-3, kinds, table, array], device="cpu")
    J = 1 + array.numpy()[int(particles.INTERNAL)]
    sloped = 1.0 / (0.8 + 0.35 * 0.25)
    expected = [0.82 + 0.18 * 0.995**10, 1.25 - 0.25 * 0.9**10, sloped - (sloped - 1) * 0.95**10, 1.0]
    assert J == pytest.approx(expected, abs=1e-5)


def pulled(material: Material, strains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(Cauchy stress along the pull, damage) of a particle stretched along x, its sides held."""
    internal, stress, damage = np.zeros((4, 1)), [], []
    for strain in strains:
        F = np.diag([1 + strain, 1.0, 1.0])[None]
        batch = update(material, F, internal=internal)
        internal = batch.internal
        stress.append(batch.tau[0, 0, 0] / (1 + strain))
        damage.append(internal[2, 0])
    return np.array(stress), np.array(damage)


def test_tearing_begins_at_the_strength_and_takes_the_fracture_energy() -> None:
    material = Material(
        model="neo_hookean", young=1e6, poisson=0.0, density=1e3, tensile_strength=1e4, fracture_energy=4.0
    )
    strains = np.linspace(0.0, 0.6, 1201)
    stress, damage = pulled(material, strains)
    assert stress.max() == pytest.approx(1e4, rel=0.03)
    assert (damage[strains < 0.0099] == 0).all() and damage[-1] > 0.99
    assert (np.diff(damage) >= -1e-6).all()
    band = 2 * VOLUME ** (1 / 3)
    assert np.trapezoid(stress, strains) * band == pytest.approx(4.0, rel=0.05)
    back, _ = pulled(material, np.array([0.6, -0.01]))
    whole, _ = pulled(Material(model="neo_hookean", young=1e6, poisson=0.0, density=1e3), np.array([-0.01]))
    assert back[1] == pytest.approx(whole[0], rel=1e-5)  # it closes as if whole


def test_torn_particles_forget_what_stretches_them() -> None:
    material = TEARING["torn_neo_hookean"]
    batch = update(material, np.diag([5.0, 1.1, 0.9])[None])
    assert batch.internal[2, 0] > 0.99
    assert np.diag(batch.F[0]) == pytest.approx([2.0, 1.1, 0.9], rel=1e-5)


@every_material
def test_damping_is_viscous_and_knows_no_substep(name: str) -> None:
    material = ALL[name].model_copy(update={"rayleigh_stiffness": 2e-3})
    n = 20
    # At rest, so that nothing flows.
    F, C = np.broadcast_to(np.eye(3), (n, 3, 3)), rates(n, 3.0)
    lam, mu = material.lame
    D = (C + C.transpose(0, 2, 1)) / 2
    trace = np.trace(D, axis1=1, axis2=2)[:, None, None]
    expected = 2e-3 * (2 * mu * D + lam * trace * np.eye(3))
    expected += 2 * (material.viscosity if material.model == "fluid" else 0) * (D - trace / 3 * np.eye(3))
    for h in (0.0, 1e-9):
        tau = update(material, F, C, h).tau
        assert np.abs(tau - expected).max() <= 1e-5 * np.abs(expected).max()
    spin = C - C.transpose(0, 2, 1)
    assert np.abs(update(material, F, spin, 0.0).tau).max() <= 1e-6 * np.abs(expected).max()


def test_damping_on_mass_is_exponential() -> None:
    material = Material(rayleigh_mass=30.0, **BASE)
    random = np.random.default_rng(0)
    F, C, v = gradients(20, 0.1), rates(20, 1.0), random.standard_normal((20, 3))
    once = update(material, F, C, 0.02, velocity=v)
    assert once.velocity == pytest.approx(math.exp(-0.6) * v, rel=1e-5, abs=1e-7)
    assert once.C == pytest.approx(math.exp(-0.6) * C, rel=1e-5, abs=1e-7)
    state = v
    for _ in range(10):
        state = update(material, F, C, 0.002, velocity=state).velocity
    assert state == pytest.approx(once.velocity, rel=1e-5, abs=1e-7)


@every_material
def test_speed_of_sound(name: str) -> None:
    material = ALL[name]
    velocity = np.array([[3.0, -4.0, 12.0]])
    speed = update(material, np.eye(3)[None], velocity=velocity).speed[0]
    more = 1 + material.critical_stretch if material.model == "snow" else 1.0
    assert sound_speed(material) * 0.999 <= speed - 13.0 <= sound_speed(material) * more * 1.001


@pytest.mark.parametrize("name", ELASTIC)
def test_speed_bounds_the_stiffness_of_deformed_matter(name: str) -> None:
    """Acoustic tensor n.A.n along many directions: density c^2 is its largest eigenvalue."""
    material, F = ELASTIC[name], gradients(30, 0.25)
    speed = update(material, F).speed
    step = 1e-4
    random = np.random.default_rng(2)
    for _ in range(30):
        n, a = random.standard_normal((2, 3))
        n, a = n / np.linalg.norm(n), a / np.linalg.norm(a)
        A = np.outer(a, n)
        middle = update(material, F).energy
        up, down = (update(material, F + sign * step * A @ F).energy for sign in (1.0, -1.0))
        stiffness = (up - 2 * middle + down) / step**2 / VOLUME
        assert (stiffness <= 1.01 * material.density * speed**2).all()


def test_particles_turned_inside_out_recover() -> None:
    U, V = rotations(6, 1), rotations(6, 2)
    stretches = np.array(
        [[1.0, 0.9, -0.3], [1, 1, 0], [2, 0.001, 0.001], [1, 0, 0], [0, 0, 0], [1.5, 1.0, 0.004]]
    )
    F = U * stretches[:, None, :] @ V
    for material in ALL.values():
        batch = update(material, F, np.zeros_like(F), 1e-4)
        assert np.isfinite(batch.tau).all() and np.isfinite(batch.speed).all()
        assert (np.linalg.det(batch.F) > 0).all()
    batch = update(ELASTIC["neo_hookean"], F)
    for i in (0, 2, 5):
        raised = (U[i] * np.maximum(stretches[i], 0.05)) @ V[i]
        assert np.abs(batch.F[i] - raised).max() <= 1e-6
    # Compression pushes back.
    assert np.trace(batch.tau[0]) < 0


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(sorted(ALL)),
    st.lists(st.floats(-8.0, 8.0, width=32), min_size=9, max_size=9),
    st.lists(st.floats(-1e4, 1e4, width=32), min_size=9, max_size=9),
    st.sampled_from([0.0, 1e-7, 1e-4, 1e-2]),
    st.floats(0.0, 3.0, width=32),
)
def test_finite_deformation_gives_finite_answers(
    name: str, F: list[float], C: list[float], h: float, memory: float
) -> None:
    internal = np.zeros((4, 2))
    internal[:2] = memory
    gradient = np.stack([np.array(F).reshape(3, 3), np.eye(3) + np.array(F).reshape(3, 3) * 1e-6])
    rate = np.broadcast_to(np.array(C).reshape(3, 3), (2, 3, 3))
    batch = update(ALL[name], gradient, rate, h, internal=internal)
    for values in (batch.F, batch.tau, batch.speed, batch.internal):
        assert np.isfinite(values).all()
    assert (np.linalg.det(batch.F) > 0).all()


def test_what_is_no_number_comes_out_in_speed() -> None:
    for material in ALL.values():
        for bad in (np.nan, np.inf):
            F = np.stack([np.eye(3), np.eye(3)])
            F[1, 0, 0] = bad
            speed = update(material, F, h=1e-4).speed
            assert np.isfinite(speed[0]) and not np.isfinite(speed[1])


def test_materials_side_by_side_are_as_alone() -> None:
    """Groups of mixed materials, and any number of threads, give the same bytes."""
    materials = tuple(ALL.values())
    n = 331
    matter = np.random.default_rng(0).integers(0, len(materials), n)
    F, C = gradients(n, 0.2), rates(n, 4.0)
    before = thread_count()
    try:
        mixed = []
        for threads in (1, 3):
            set_thread_count(threads)
            mixed.append(update(materials, F, C, 1e-3, matter=matter))
    finally:
        set_thread_count(before)
    for field in ("tau", "F", "internal", "speed"):
        assert np.array_equal(getattr(mixed[0], field), getattr(mixed[1], field))
    for number, material in enumerate(materials):
        chosen = matter == number
        alone = update(material, F[chosen], C[chosen], 1e-3)
        for field in ("tau", "F", "speed"):
            assert np.array_equal(getattr(mixed[0], field)[chosen], getattr(alone, field))


@pytest.mark.cuda
@needs_gpu
def test_a_gpu_answers_as_the_cpu() -> None:
    materials = tuple(ALL.values())
    n = 400
    matter = np.random.default_rng(0).integers(0, len(materials), n)
    F, C = gradients(n, 0.2), rates(n, 4.0)
    cpu, gpu = (update(materials, F, C, 1e-3, matter=matter, device=device) for device in ("cpu", "cuda:0"))
    for field in ("tau", "F", "internal", "speed", "energy"):
        a, b = getattr(cpu, field), getattr(gpu, field)
        assert np.abs(a - b).max() <= 2e-5 * np.abs(a).max()
