"""Rigid bodies in MuJoCo among soft ones in MPM."""

from __future__ import annotations

PROBLEMS = ()

__all__ = ["PROBLEMS"]
