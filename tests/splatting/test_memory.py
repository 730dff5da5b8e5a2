"""Peak memory of an image and its gradients."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from tests.conditions import posix_only

SCRIPT = """
import json, resource, sys
import torch
from gdpro_sim.splatting import rasterization
from tests.benchmarks.splatting_scene import bumpy_sphere, front_camera

count, size, degree = map(int, sys.argv[1:])

def run(count, size):
    scene = {k: v.requires_grad_() for k, v in bumpy_sphere(count, degree).items()}
    cameras = front_camera(size)
    weights = torch.ones(1, size, size, 3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    image, alphas, meta = rasterization(
        **scene, viewmats=cameras.viewmats, Ks=cameras.Ks, width=size, height=size, sh_degree=degree)
    gradients = torch.autograd.grad(image, list(scene.values()), weights)
    returned = [meta[k] for k in ("means2d", "depths", "opacities", "radii", "transmittance", "flatten_ids")]
    held = [*scene.values(), image, alphas, *returned, *gradients]
    return peak, sum(t.nbytes for t in held), sum(t.nbytes for t in [*scene.values(), weights])

run(2000, 64)  # compile and load
peak, held, inputs = run(count, size)
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
# What the call added to the peak, and its inputs, which were there before.
print(json.dumps({"peak": (after - peak) * 1024 + inputs, "held": held}))
"""


@posix_only
@pytest.mark.parametrize(("degree", "threads"), [(0, 2), (3, 2), (3, 16)])
def test_peak_is_within_twice_what_goes_in_and_out(degree: int, threads: int) -> None:
    """With many threads and few numbers per Gaussian what is spilled between slabs can come to more."""
    environment = {**os.environ, "GDPRO_THREADS": str(threads)}
    command = [sys.executable, "-c", SCRIPT, "400000", "512", str(degree)]
    result = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    sizes = json.loads(result.stdout.strip().splitlines()[-1])
    interpreter = 4_000_000  # what Python and torch take besides, now and then
    assert sizes["peak"] <= 2 * sizes["held"] + interpreter, sizes
