"""What the materials of MPM particles answer to a deformation: stress, plastic flow, damage, speed of sound.

`update_stress` takes the trial deformation gradient F (the elastic one of the last substep, moved on by the
velocity gradient C) and writes the Kirchhoff stress tau = J sigma times the volume at rest. With the singular
values s of F, e = log s, J = det F, b = F F^T, and the energies of `gdpro_sim.kernels.elasticity`:

    STABLE_NEO_HOOKEAN  tau = mu b + J U'(J), U'(J) = (lambda + mu) (J - 1) - mu and the barrier
    NEO_HOOKEAN         tau = mu (b - 1) + lambda log J
    COROTATED           tau_i = 2 mu s_i (s_i - 1) + lambda J (J - 1) and the barrier
    STVK_HENCKY         tau_i = 2 mu e_i + lambda tr e, within von Mises' limit, see
                        `gdpro_sim.kernels.plasticity`
    DRUCKER_PRAGER      the same, within a cone of friction; volume gained in the open is given back before
                        it resists anew (Klar et al. 2016, "Drucker-Prager elastoplasticity for sand
                        animation", ACM TOG 35(4); Tampubolon et al. 2017, "Multi-species simulation of
                        porous sand and water mixtures", ACM TOG 36(4))
    SNOW                corotated times exp(xi (1 - J_p)), s within [1 - theta_c, 1 + theta_s] (Stomakhin et
                        al. 2013, "A material point method for snow simulation", ACM TOG 32(4))
    HERSCHEL_BULKLEY    Hencky's law; shear stress past the yield stress flows at the rate at which
                        stress = yield + k rate^n, implicitly (Yue et al. 2015, "Continuum foam", ACM TOG
                        34(5); here in logarithmic strains, which keep volume exactly)
    FLUID               J alone resists: p = K / 7 (J^-7 - 1), no tension (Monaghan 1994, "Simulating free
                        surface flows with SPH", JCP 110); Newtonian shear viscosity. J follows the
                        velocity's divergence, and the grid's density where particles have clumped (slowly)
                        or come apart

Plastic flow needs the eigenvectors Q of b alone, no singular value decomposition: F becomes
Q diag(s_new / s) Q^T F.

Elastic and von Mises' matter with a tensile strength f tears: principal (Cauchy) stress past f is released as
damage d grows, (1 - d) sigma = f exp(-k (sigma / f - 1)) for the largest one of undamaged matter (Rankine;
Jirasek & Bauer 2012, "Numerical aspects of the crack band approach", Comput. Struct. 110), where k spends the
fracture energy over a band of two particles (Bazant & Oh 1983, "Crack band theory for fracture of concrete",
Mater. Struct. 16). Tension in other directions falls with it; compression is carried on. A torn particle
forgets stretch past two.

Damping is objective and knows no substep: viscous stress 2 a mu D + a lambda tr D with the rate of
deformation D and Rayleigh's stiffness damping a; velocities decay by exp(-h rate) for that on mass.

INTERNAL remembers, from zeros on:

    0  accumulated plastic strain (Hencky, Herschel-Bulkley), log of the volume gained in the open (sand),
       J_p - 1 (snow), J - 1 (fluid)
    1  how far the principal stress has passed the tensile strength, as a multiple of it
    2  damage, 0 to 1
    3  what rounding cuts off number 0

A gradient that one substep has turned inside out or almost flat (J < 0.01) is recovered by raising its
singular values to 0.05. Numbers that are not finite stay so, and come out in SPEED.

Precision: b - 1 and J - 1 are formed in float64 from F and its low part, so strains keep seven digits however
small; from there float32 is enough. On a CPU 16 particles are done side by side.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.elasticity import COROTATED, NEO_HOOKEAN, STABLE_NEO_HOOKEAN, STVK_HENCKY
from gdpro_sim.kernels.lane_math import LANE_MATH
from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.mpm_groups import GROUP, LANES, degenerate_lanes, first_of_group, recover

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

DRUCKER_PRAGER = wp.constant(5)
SNOW = wp.constant(6)
HERSCHEL_BULKLEY = wp.constant(7)
FLUID = wp.constant(8)

# Columns of the table of materials, one row each; what A, B and C are belongs to the law.
LAW = wp.constant(0)
MU = wp.constant(1)  # Lame parameters, Pa
LAM = wp.constant(2)
LIGHTNESS = wp.constant(3)  # 1 / density, m^3/kg
DAMPING = wp.constant(4)  # Rayleigh's, on stiffness, s
DRAG = wp.constant(5)  # Rayleigh's, on mass, 1/s
YIELD = wp.constant(6)  # von Mises' yield stress, Pa; huge: never
HARDENING = wp.constant(7)  # Pa
STRENGTH = wp.constant(8)  # tensile, Pa; zero: does not tear
BAND = wp.constant(9)  # fracture energy * Young's modulus / strength^2, m
A = wp.constant(10)  # cone's slope | theta_c | log consistency | viscosity, Pa s
B = wp.constant(11)  # cone's tip, volume strain | theta_s | flow index
C = wp.constant(12)  # log J over which cohesion is lost | xi
COLUMNS = wp.constant(13)

PACKING = (5.0, 0.02)
"""Where a fluid's particles have clumped, J falls towards the grid's ratio of volumes and this much more, at
this rate, 1/s: else J, which is integrated along the particles, would drift from where they are."""

PARTING = 100.0
"""1/s, at which J rises towards the grid's ratio of volumes where particles lie further apart: else a fluid
that has come apart would not come together again."""

EDGE = (0.35, 0.5)
"""Near a fluid's surface the grid is lighter because it sees the air: so many times the change of density
over a cell are added to the density, and where it changes by the second number (relative) J does not rise."""

LOOSE = 2.0
"""Largest J - 1 that a fluid remembers."""


def groups(count: int, device: str) -> int:
    """Indices to launch `update_stress` over for `count` particles."""
    return -(-count // LANES) if device == "cpu" else count


_CONSTANTS = "".join(
    f"    const int {name} = {int(value)};\n"
    for name, value in {
        "STABLE_NEO_HOOKEAN": STABLE_NEO_HOOKEAN,
        "NEO_HOOKEAN": NEO_HOOKEAN,
        "COROTATED": COROTATED,
        "STVK_HENCKY": STVK_HENCKY,
        "DRUCKER_PRAGER": DRUCKER_PRAGER,
        "SNOW": SNOW,
        "HERSCHEL_BULKLEY": HERSCHEL_BULKLEY,
        "FLUID": FLUID,
        "LAW": LAW,
        "MU": MU,
        "LAM": LAM,
        "LIGHTNESS": LIGHTNESS,
        "DAMPING": DAMPING,
        "DRAG": DRAG,
        "YIELD": YIELD,
        "HARDENING": HARDENING,
        "STRENGTH": STRENGTH,
        "BAND": BAND,
        "A": A,
        "B": B,
        "C": C,
        "COLUMNS": COLUMNS,
    }.items()
)  # fmt: skip

_BEGIN = """
    // Materials.
    const int* const kinds = matter.data + first;
    const float* const constants = table.data;
    bool uniform = true;
    for (int j = 1; j < lanes; ++j) uniform &= kinds[j] == kinds[0];
    auto constant = [&](int column) {
        F v = splat(constants[(size_t)kinds[0] * COLUMNS + column]);
#if !defined(__CUDACC__)
        if (!uniform)
            for (int j = 1; j < lanes; ++j) v[j] = constants[(size_t)kinds[j] * COLUMNS + column];
#endif
        return v;
    };
    const F zero = splat(0.0f), one = splat(1.0f);
    const F law = constant(LAW), mu = constant(MU), lam = constant(LAM), strength = constant(STRENGTH);
    const I fluid = law == (float)FLUID;
    const I hencky = (law == (float)STVK_HENCKY) | (law == (float)HERSCHEL_BULKLEY)
        | (law == (float)DRUCKER_PRAGER);
    const I sand = law == (float)DRUCKER_PRAGER, pasty = law == (float)HERSCHEL_BULKLEY;
    const I snow = law == (float)SNOW, tears = strength > 0.0f;
    const I neo = law == (float)NEO_HOOKEAN, stable = law == (float)STABLE_NEO_HOOKEAN;
    const I corotated = law == (float)COROTATED;
    const I principal = hencky | snow | corotated | tears;

    // b - 1 and J - 1.
    D f[9];
    for (int i = 0; i < 9; ++i) f[i] = wide(row(DEFORMATION + i)) + wide(row(DEFORMATION_LOW + i));
    D g[9];
    for (int i = 0; i < 9; ++i) g[i] = i % 4 == 0 ? f[i] - 1.0 : f[i];
    const D w00 = g[0] + g[0] + g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
    const D w11 = g[4] + g[4] + g[3] * g[3] + g[4] * g[4] + g[5] * g[5];
    const D w22 = g[8] + g[8] + g[6] * g[6] + g[7] * g[7] + g[8] * g[8];
    const D w01 = g[1] + g[3] + g[0] * g[3] + g[1] * g[4] + g[2] * g[5];
    const D w02 = g[2] + g[6] + g[0] * g[6] + g[1] * g[7] + g[2] * g[8];
    const D w12 = g[5] + g[7] + g[3] * g[6] + g[4] * g[7] + g[5] * g[8];
    const F b00 = narrow(w00), b11 = narrow(w11), b22 = narrow(w22);
    const F b01 = narrow(w01), b02 = narrow(w02), b12 = narrow(w12);
    const D m0 = g[4] * g[8] - g[5] * g[7], m1 = g[3] * g[8] - g[5] * g[6], m2 = g[3] * g[7] - g[4] * g[6];
    const D minors = m0 + (g[0] * g[4] - g[1] * g[3]) + (g[0] * g[8] - g[2] * g[6]);
    const F d = narrow(g[0] + g[4] + g[8] + minors + (g[0] * m0 - g[1] * m1 + g[2] * m2));
    F J = d + 1.0f;

    // Velocity gradient, where something looks at it.
    const F damping = constant(DAMPING), drag = constant(DRAG);
    const F viscosity = select(fluid, constant(A), zero);
    const I moved = fluid | (damping > 0.0f) | (drag > 0.0f);
    F c[9];
    if (any(moved)) for (int i = 0; i < 9; ++i) c[i] = row(AFFINE + i);

    // tau: xx yy zz xy xz yz. stiff: density times the square of the largest speed of sound.
    F tau[6], stiff = zero, damage = zero, change = zero;  // change: of what is remembered
    for (int i = 0; i < 6; ++i) tau[i] = zero;
    const I remembers = hencky | snow | fluid | tears;
    D memory = wide(zero);
    if (any(remembers)) memory = wide(row(INTERNAL)) + wide(row(INTERNAL + 3));

    // Elastic pressure of the neo-Hookean and corotated laws, and its stiffness.
    F pressure = zero;
    if (any(neo)) {
        const F log = log_of(J, d);
        pressure = select(neo, lam * log, pressure);
        stiff = select(neo, mu + lam * max_(1.0f - log, zero), stiff);
    }
    if (any(stable | corotated)) {
        const I smooth = stable | corotated;
        const F bulk = select(stable, lam + mu, lam), slope = select(stable, mu, zero);
        F p = d * (bulk * J - slope), k = bulk * J * J;
        const I flat = J < 0.2f;
        if (any(flat)) {
            const F x = J - 0.2f, log = log_(J * 5.0f), twice = 2.0f * (lam + mu);
            p -= select(flat, twice * (2.0f * J * x * log + x * x), zero);
            k -= select(flat, twice * (2.0f * J * J * log + 4.0f * x * J - x * x), zero);
        }
        pressure = select(smooth, p, pressure);
        stiff = select(smooth, k, stiff);
    }
    const I direct = (neo | stable) & (strength <= 0.0f);
    if (any(direct)) {
        const F mean = (b00 + b11 + b22) * (1.0f / 3.0f);
        const F x = b00 - mean, y = b11 - mean, z = b22 - mean;
        const F off = b01 * b01 + b02 * b02 + b12 * b12;
        // No eigenvalue of b is further from their mean than this.
        const F spread = sqrt_((x * x + y * y + z * z + 2.0f * off) * (2.0f / 3.0f));
        stiff = select(direct, stiff + mu * (1.0f + mean + spread), stiff);
        tau[0] = select(direct, mu * b00 + pressure, zero);
        tau[1] = select(direct, mu * b11 + pressure, zero);
        tau[2] = select(direct, mu * b22 + pressure, zero);
        tau[3] = select(direct, mu * b01, zero);
        tau[4] = select(direct, mu * b02, zero);
        tau[5] = select(direct, mu * b12, zero);
    }
"""

_PRINCIPAL = """
    if (any(principal)) {
        // Eigenvalues x of b - 1 by Cardano's formula; the discriminant and the scale are float64.
        const D third = (w00 + w11 + w22) * (1.0 / 3.0);
        const D v00 = w00 - third, v11 = w11 - third, v22 = w22 - third;
        const D square = (v00 * v00 + v11 * v11 + v22 * v22
            + 2.0 * (w01 * w01 + w02 * w02 + w12 * w12)) * (1.0 / 6.0);
        const D half = 0.5 * (v00 * (v11 * v22 - w12 * w12) - w01 * (w01 * v22 - w12 * w02)
            + w02 * (w01 * w12 - v11 * w02));
        const F radius2 = narrow(square);
        const I spreads = radius2 > 1.0e-36f;
        const F inverse = select(spreads, rsqrt_(select(spreads, radius2, one)), zero);
        const D scale = wide(inverse) * wide(inverse) * wide(inverse);
        const D cosine = half * scale;
        const F sine2 = narrow(square * square * square * scale * scale - cosine * cosine);
        const F angle = angle_(sqrt_(max_(sine2, zero)), narrow(cosine)) * (1.0f / 3.0f);
        const F radius = radius2 * inverse, mean = narrow(third);
        const F along = radius * cos_(angle), across = 1.7320508f * radius * sin_(angle);
        const F y[3] = {along + along, across - along, -across - along};
        F x[3];
        for (int i = 0; i < 3; ++i) x[i] = max_(mean + y[i], splat(-1.0f + 1.0e-6f));
        F s[3], rise[3], t[3], back[3] = {zero, zero, zero};  // rise: s - 1, back: s_new / s - 1
        for (int i = 0; i < 3; ++i) {
            s[i] = sqrt_(x[i] + 1.0f);
            rise[i] = x[i] / (s[i] + 1.0f);
            t[i] = select(corotated, 2.0f * mu * s[i] * rise[i], mu * x[i]) + pressure;
        }
        const F widest = x[0];
        const F shear = select(corotated, mu + mu, mu) * (1.0f + widest);
        stiff = select(principal & (neo | stable | corotated), stiff + shear, stiff);
        I flows = zero > 1.0f;

        if (any(hencky)) {
            F e[3];
            for (int i = 0; i < 3; ++i) e[i] = 0.5f * log_of(x[i] + 1.0f, x[i]);
            const F trace = e[0] + e[1] + e[2], mean = trace * (1.0f / 3.0f);
            F dev[3];
            for (int i = 0; i < 3; ++i) dev[i] = e[i] - mean;
            const F size = sqrt_(dev[0] * dev[0] + dev[1] * dev[1] + dev[2] * dev[2]);
            const F divisor = max_(size, splat(1.0e-30f)), known = narrow(memory);
            F lost = zero, total = trace;  // 1 - (size after / before), and the trace after
            if (any(law == (float)STVK_HENCKY)) {
                const F hardening = constant(HARDENING), q = 2.4494897f * mu * size;
                const F over = max_(q - (constant(YIELD) + hardening * known), zero);
                const F growth = over / (3.0f * mu + hardening);
                const I metal = (law == (float)STVK_HENCKY) & (growth > 0.0f);
                lost = select(metal, 1.2247449f * growth / divisor, lost);
                change = select(metal, growth, change);
            }
            if (any(pasty)) {
                const F shear = 1.4142136f * mu * size, limit = constant(YIELD) * 0.57735027f;
                const F over = shear - limit;
                const I yields = pasty & (over > 0.0f);
                if (any(yields)) {
                    // log(k rate^n + mu h rate) = log over, in y = log rate: convex, from above.
                    const F index = constant(B), log_over = log_(max_(over, splat(1.0e-30f)));
                    const F thick = constant(A) - log_over;
                    const F quick = log_(max_(mu * h, splat(1.0e-30f))) - log_over;
                    F y = min_(-thick / index, -quick);
                    F viscous = one, elastic = zero;
                    for (int i = 0; i < 6; ++i) {
                        viscous = exp_(thick + index * y);
                        elastic = exp_(quick + y);
                        const F sum = viscous + elastic, off = log_(sum);
                        const I far = yields & (off > 2.0e-6f);
                        if (!any(far)) break;
                        y -= select(far, off * sum / (index * viscous + elastic), zero);
                    }
                    const F relaxed = over * elastic / (viscous + elastic);
                    lost = select(yields, relaxed / max_(shear, splat(1.0e-30f)), lost);
                    change = select(yields, 0.81649658f * size * lost, change);
                }
            }
            if (any(sand)) {
                const F room = max_(min_(1.0f - known / constant(C), one), zero);
                const F tip = constant(B) * room, opened = trace + known;
                const F over = size + (1.5f * lam / mu + 1.0f) * (opened - tip) * constant(A);
                const I parted = opened >= tip;
                lost = select(sand, select(parted, one, max_(over, zero) / divisor), lost);
                total = select(sand, select(parted, tip, opened), total);
                change = select(sand, select(parted, trace - tip, -known), change);
            }
            for (int i = 0; i < 3; ++i) {
                const F after = (1.0f - lost) * dev[i] + total * (1.0f / 3.0f);
                const F more = (total - trace) * (1.0f / 3.0f) - lost * dev[i];
                t[i] = select(hencky, 2.0f * mu * after + lam * total, t[i]);
                back[i] = select(hencky, expm1_(more), back[i]);
            }
            flows = flows | (hencky & ((lost != 0.0f) | (total != trace)));
            const F least = min_(min_(t[0], t[1]), min_(t[2], zero));
            stiff = select(hencky, lam + 2.0f * mu - least + mu * max_(widest, zero), stiff);
        }
        if (any(snow)) {
            const F low = -constant(A), high = constant(B);
            F kept[3], r[3];
            for (int i = 0; i < 3; ++i) {
                kept[i] = max_(min_(rise[i], high), low);
                r[i] = (rise[i] - kept[i]) / (kept[i] + 1.0f);
                back[i] = select(snow, (kept[i] - rise[i]) / s[i], back[i]);
                flows = flows | (snow & (kept[i] != rise[i]));
            }
            const F known = narrow(memory);
            const F after = known + (1.0f + known) * PRODUCT(r);
            const F bounded = max_(min_(after, splat(19.0f)), splat(-0.4f));
            change = select(snow, bounded - known, change);
            const F hard = exp_(-constant(C) * bounded), e = PRODUCT(kept), p = lam * e * (e + 1.0f);
            for (int i = 0; i < 3; ++i)
                t[i] = select(snow, hard * (2.0f * mu * (kept[i] + 1.0f) * kept[i] + p), t[i]);
            const F square = (high + 1.0f) * (high + 1.0f);
            stiff = select(snow, hard * (2.0f * mu * square + lam * (e + 1.0f) * (e + 1.0f)), stiff);
        }
        if (any(tears)) {
            const F most = max_(max_(t[0], t[1]), t[2]);
            const I strong = tears & (most > 0.0f);
            const F ratio = select(strong, most / (strength * max_(J, splat(1.0e-6f))), zero);
            const F past = max_(row(INTERNAL + 1), ratio - 1.0f);
            const F band = 2.0f * exp_(log_(row(VOLUME)) * (1.0f / 3.0f));
            const F brittle = 1.0f / max_(constant(BAND) / band - 0.5f, splat(0.1f));
            const F torn = (past - expm1_(-brittle * past)) / (past + 1.0f);
            damage = select(tears & (past > 0.0f), torn, zero);
            for (int i = 0; i < 3; ++i) {
                t[i] = select(tears & (t[i] > 0.0f), t[i] * (1.0f - damage), t[i]);
                const I wide_open = tears & (damage > 0.99f) & (s[i] * (back[i] + 1.0f) > 2.0f);
                back[i] = select(wide_open, 2.0f / s[i] - 1.0f, back[i]);
                flows = flows | wide_open;
            }
            put(INTERNAL + 1, select(tears, max_(past, zero), row(INTERNAL + 1)));
            put(INTERNAL + 2, select(tears, damage, row(INTERNAL + 2)));
        }

        // A function of the principal values is a polynomial of v = b - 1 - mean: Newton's, by differences.
        const F g00 = narrow(v00), g11 = narrow(v11), g22 = narrow(v22), g01 = b01, g02 = b02, g12 = b12;
        const F s00 = g00 * g00 + g01 * g01 + g02 * g02, s11 = g01 * g01 + g11 * g11 + g12 * g12;
        const F s22 = g02 * g02 + g12 * g12 + g22 * g22, s01 = g00 * g01 + g01 * g11 + g02 * g12;
        const F s02 = g00 * g02 + g01 * g12 + g02 * g22, s12 = g01 * g02 + g11 * g12 + g12 * g22;
        const F span = y[0] - y[2], gap = (y[1] - y[2]) * (y[1] - y[0]);
        const F per_span = select(span > 0.0f, 1.0f / span, zero);
        const F per_gap = select(gap < -1.0e-7f * span * span, 1.0f / gap, zero);
        auto spread = [&](const F* value, F* out) {
            const F slope = (value[0] - value[2]) * per_span;
            const F bend = ((value[1] - value[2]) - slope * (y[1] - y[2])) * per_gap;
            const F linear = slope - bend * (y[0] + y[2]);
            const F constant = value[2] - slope * y[2] + bend * (y[0] * y[2]);
            out[0] = constant + linear * g00 + bend * s00;
            out[1] = constant + linear * g11 + bend * s11;
            out[2] = constant + linear * g22 + bend * s22;
            out[3] = linear * g01 + bend * s01;
            out[4] = linear * g02 + bend * s02;
            out[5] = linear * g12 + bend * s12;
        };
        F whole[6];
        spread(t, whole);
        for (int i = 0; i < 6; ++i) tau[i] = select(principal, whole[i], tau[i]);
        if (any(flows)) {
            // F grows by (Q diag(back) Q^T) F.
            F more[6];
            spread(back, more);
            const F M[9] = {
                more[0], more[3], more[4], more[3], more[1], more[5], more[4], more[5], more[2]};
            for (int j = 0; j < 3; ++j) {
                const F column[3] = {narrow(f[j]), narrow(f[3 + j]), narrow(f[6 + j])};
                for (int i = 0; i < 3; ++i) {
                    const F step = M[3 * i] * column[0] + M[3 * i + 1] * column[1] + M[3 * i + 2] * column[2];
                    const D sum = f[3 * i + j] + wide(select(flows, step, zero));
                    const F high = narrow(sum);
                    put(DEFORMATION + 3 * i + j, high);
                    put(DEFORMATION_LOW + 3 * i + j, narrow(sum - wide(high)));
                }
            }
        }
    }
"""

_FLUID = """
    if (any(fluid)) {
        F r[9];
        for (int i = 0; i < 9; ++i) r[i] = h * c[i];
        const F m0 = r[4] * r[8] - r[5] * r[7], m1 = r[3] * r[8] - r[5] * r[6];
        const F m2 = r[3] * r[7] - r[4] * r[6];
        const F growth = r[0] + r[4] + r[8] + (m0 + (r[0] * r[4] - r[1] * r[3]) + (r[0] * r[8] - r[2] * r[6]))
            + (r[0] * m0 - r[1] * m1 + r[2] * m2);
        const F known = narrow(memory);
        F more = (known + 1.0f) * growth;
        if (particles.shape[0] > DENSITY) {
            const F packed = row(DENSITY) * constant(LIGHTNESS);
            const F slope = row(SLOPE) * constant(LIGHTNESS);
            const F least = 1.0f / max_(packed, splat(0.1f)) - 1.0f + SPARE;
            const F most = 1.0f / max_(packed + EDGE * slope, splat(0.1f)) - 1.0f;
            const F inside = select(packed > 0.0f, max_(1.0f - slope * (1.0f / STEEP), zero), zero);
            more += min_(least - known, zero) * min_(splat(h * PACKING), one);
            more += inside * max_(most - known, zero) * min_(splat(h * PARTING), one);
        }
        const F after = known + more;
        const F bounded = max_(min_(after, splat(LOOSE)), splat(-0.7f));
        change = select(fluid, select(bounded == after, more, bounded - known), change);
        const F p = max_(lam * (1.0f / 7.0f) * expm1_(-7.0f * log1p_(bounded)), zero);
        J = select(fluid, min_(bounded + 1.0f, one), J);  // volume that carries stress
        for (int i = 0; i < 3; ++i) tau[i] = select(fluid, -J * p, tau[i]);
        stiff = select(fluid, J * (7.0f * p + lam), stiff);
        for (int i = 0; i < 9; ++i) {
            put(DEFORMATION + i, select(fluid, i % 4 == 0 ? one : zero, row(DEFORMATION + i)));
            put(DEFORMATION_LOW + i, select(fluid, zero, row(DEFORMATION_LOW + i)));
        }
    }
"""

_END = """
    if (any(remembers)) {
        memory += wide(change);
        const F high = narrow(memory);
        put(INTERNAL, high);
        put(INTERNAL + 3, narrow(memory - wide(high)));
    }

    // Viscosity: that of damping, and a fluid's own.
    if (any((damping > 0.0f) | (viscosity > 0.0f))) {
        const F whole = damping * (1.0f - damage);
        const F twice = 2.0f * (whole * mu + viscosity * J);
        const F rest = (whole * lam - (2.0f / 3.0f) * viscosity * J) * (c[0] + c[4] + c[8]);
        tau[0] += twice * c[0] + rest;
        tau[1] += twice * c[4] + rest;
        tau[2] += twice * c[8] + rest;
        tau[3] += twice * 0.5f * (c[1] + c[3]);
        tau[4] += twice * 0.5f * (c[2] + c[6]);
        tau[5] += twice * 0.5f * (c[5] + c[7]);
    }
    const F volume = row(VOLUME);
    for (int i = 0; i < 6; ++i) put(STRESS + i, volume * tau[i]);

    F v[3];
    for (int i = 0; i < 3; ++i) v[i] = row(VELOCITY + i);
    if (any(drag > 0.0f)) {
        const F slower = exp_(-h * drag);
        for (int i = 0; i < 3; ++i) put(VELOCITY + i, v[i] = v[i] * slower);
        for (int i = 0; i < 9; ++i) put(AFFINE + i, c[i] * slower);
    }
    const F speed = sqrt_(stiff * constant(LIGHTNESS)) + sqrt_(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    put(SPEED, speed + (d - d));  // no number where F is none
"""

_UPDATE = f"""
{GROUP}
{_CONSTANTS}
#define PRODUCT(v) (v[0] + v[1] + v[2] + v[0] * v[1] + v[0] * v[2] + v[1] * v[2] + v[0] * v[1] * v[2])
#define LOOSE {LOOSE}f
#define PACKING {PACKING[0]}f
#define SPARE {PACKING[1]}f
#define PARTING {PARTING}f
#define EDGE {EDGE[0]}f
#define STEEP {EDGE[1]}f
{LANE_MATH}
{_BEGIN}
{_PRINCIPAL}
{_FLUID}
{_END}
#undef PRODUCT
#undef LOOSE
#undef PACKING
#undef SPARE
#undef PARTING
#undef EDGE
#undef STEEP
"""


@wp.func_native(_UPDATE)
def update_group(
    group: int,
    h: float,
    matter: wp.array[wp.int32],
    table: wp.array2d[float],
    particles: wp.array2d[float],
):
    """`update_stress` of one group, none of whose particles is degenerate."""
    ...


@wp.kernel
def update_stress(
    start: int,
    # In:
    h: float,
    matter: wp.array[wp.int32],
    table: wp.array2d[float],
    # Out:
    particles_out: wp.array2d[float],
):
    """The materials' answer to a substep of h seconds; with h = 0, to the deformation as it is.

    In: rows DEFORMATION (trial) and DEFORMATION_LOW, AFFINE (the velocity gradient), VELOCITY, VOLUME,
    INTERNAL, and DENSITY and SLOPE where there are such. Out: STRESS, SPEED, INTERNAL; DEFORMATION and its
    low part where matter flows; VELOCITY and AFFINE under damping on mass. Indices are `groups`. `matter` [N]
    are rows of `table` [materials, COLUMNS].
    """
    group = start + wp.tid()
    mask = degenerate_lanes(group, matter, particles_out)
    for j in range(wp.where(mask == 0, 0, wp.static(LANES))):
        if (mask >> j) & 1 == 1:
            recover(first_of_group(group) + j, particles_out)
    update_group(group, h, matter, table, particles_out)
