"""Von Mises plasticity with linear isotropic hardening, in principal logarithmic strains.

F = F_e F_p with Hencky's law for F_e: principal Kirchhoff stresses are those of small-strain elasticity in
the strains e_i = log s_i(F_e). They are limited by q = sqrt(3/2) |dev tau| <= sigma_y + H p, where p is the
accumulated plastic strain. Integrating the flow rule with the exponential map makes the return mapping the
radial return of small strains and keeps det F_p = 1 exactly (Simo 1992, "Algorithms for static and dynamic
multiplicative plasticity", CMAME 99; de Souza Neto, Peric & Owen 2008, "Computational Methods for
Plasticity", ch. 7 and 14).

A step's return mapping is the minimum of elastic energy plus dissipation over p, so implicit steps keep a
potential (Ortiz & Stainier 1999, CMAME 171; Li, Li & Jiang 2022, "Energetically consistent inelasticity for
optimization time integration", ACM TOG 41(4)). With trial strains e and over = max(q(e) - sigma_y - H p, 0):

    W(e) = mu e:e + lambda/2 tr(e)^2 - over^2 / (2 (3 mu + H))
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

ROOT_SIX = wp.constant(wp.float64(2.449489742783178))


@wp.func
def log_stretches(s: wp.vec3d) -> wp.vec3d:
    """Logarithms of principal stretches > 0: Hencky's strains."""
    return wp.vec3d(wp.log(s[0]), wp.log(s[1]), wp.log(s[2]))


@wp.func
def deviator(e: wp.vec3d) -> wp.vec3d:
    """Principal values less their mean."""
    mean = (e[0] + e[1] + e[2]) / wp.float64(3.0)
    return wp.vec3d(e[0] - mean, e[1] - mean, e[2] - mean)


@wp.func
def equivalent_stress(e: wp.vec3d, mu: wp.float64) -> wp.float64:
    """Von Mises stress sqrt(3/2) |2 mu dev e| of elastic strains e, Pa."""
    return ROOT_SIX * mu * wp.length(deviator(e))


@wp.func
def excess_stress(e: wp.vec3d, mu: wp.float64, limit: wp.float64) -> wp.float64:
    """How far trial strains e pass the yield stress `limit` (inf: never), Pa."""
    return wp.max(equivalent_stress(e, mu) - limit, wp.float64(0.0))


@wp.func
def return_mapping(e: wp.vec3d, mu: wp.float64, limit: wp.float64, hardening: wp.float64):
    """(elastic strains after plastic flow, growth of the accumulated plastic strain).

    e:         trial strains, log of the principal stretches of F F_p^-1
    limit:     present yield stress sigma_y + H p, Pa
    hardening: H, Pa
    """
    growth = excess_stress(e, mu, limit) / (wp.float64(3.0) * mu + hardening)
    elastic = e
    if growth > wp.float64(0.0):
        elastic = e - wp.float64(3.0) * mu * growth / equivalent_stress(e, mu) * deviator(e)
    return elastic, growth


@wp.func
def flow(s: wp.vec3d, V: wp.mat33d, mu: wp.float64, limit: wp.float64, hardening: wp.float64):
    """(G, growth) for a trial F F_p^-1 = U diag(s) V^T: F_p^-1 becomes F_p^-1 G, det G = 1."""
    e = log_stretches(s)
    elastic, growth = return_mapping(e, mu, limit, hardening)
    back = elastic - e
    stretch = wp.diag(wp.vec3d(wp.exp(back[0]), wp.exp(back[1]), wp.exp(back[2])))
    return V * stretch * wp.transpose(V), growth
