"""Problems with known answers for each solver; `gdpro verify` runs them."""

from __future__ import annotations

import importlib

from gdpro_sim.simulation.verification.framework import Problem

SOLVERS = ("fem", "mpm", "mujoco", "coupling")
"""Solvers that have problems: one module of this package each, with a tuple PROBLEMS."""


def problems(solver: str) -> tuple[Problem, ...]:
    """The problems of one of SOLVERS, in the order they are run."""
    module = importlib.import_module(f"{__name__}.{solver}")
    found: tuple[Problem, ...] = module.PROBLEMS
    return found


__all__ = ["SOLVERS", "problems"]
