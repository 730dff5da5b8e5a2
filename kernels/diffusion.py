"""Elementwise parts of score distillation over flat float32 arrays.

With the noise schedule's signal = sqrt(alpha_bar) and sigma = sqrt(1 - alpha_bar). The index of each kernel
is a span of `span` consecutive numbers, so that a CPU works on them in vectors: one on a GPU, thousands on a
CPU. An output may lie on an input.
"""

import warp as wp

# Products are not fused into sums: the numbers are those of the formula, term by term, on every device.
wp.set_module_options({"enable_backward": False, "fuse_fp": False, "default_grid_stride": False})


def _loop(body: str) -> str:
    return f"""
    const size_t size = x.shape[0], first = (size_t)index * span;
    const size_t stop = first + span < size ? first + span : size;
    for (size_t i = first; i < stop; ++i) {{
        {body}
    }}
"""


@wp.func_native(_loop("out.data[i] = a * x.data[i] + b * y.data[i];"))
def combine_span(
    index: int,
    span: int,
    x: wp.array[float],
    a: float,
    y: wp.array[float],
    b: float,
    out: wp.array[float],
): ...


@wp.kernel
def combine(
    start: int,
    # In:
    span: int,
    x: wp.array[float],
    a: float,
    y: wp.array[float],
    b: float,
    # Out:
    sum_out: wp.array[float],
):
    """a x + b y: noising, and the noise in a v-prediction or in a posterior mean."""
    combine_span(start + wp.tid(), span, x, a, y, b, sum_out)


_MOVE = """
        const float e = noise.data[i];
        const float clean = (x.data[i] - sigma_from * e) / signal_from;
        out.data[i] = signal_to * clean + sigma_to * e;
"""


@wp.func_native(_loop(_MOVE))
def ddim_span(
    index: int,
    span: int,
    x: wp.array[float],
    noise: wp.array[float],
    signal_from: float,
    sigma_from: float,
    signal_to: float,
    sigma_to: float,
    out: wp.array[float],
): ...


@wp.kernel
def ddim_move(
    start: int,
    # In:
    span: int,
    x: wp.array[float],
    noise: wp.array[float],
    signal_from: float,
    sigma_from: float,
    signal_to: float,
    sigma_to: float,
    # Out:
    x_out: wp.array[float],
):
    """Deterministic DDIM from one step to another, up or down (Song et al. 2021, eq. 12 with sigma_t = 0)."""
    ddim_span(start + wp.tid(), span, x, noise, signal_from, sigma_from, signal_to, sigma_to, x_out)


@wp.func_native(_loop("out.data[i] = x.data[i] + scale * (positive.data[i] - x.data[i]);"))
def guidance_span(
    index: int,
    span: int,
    x: wp.array[float],
    positive: wp.array[float],
    scale: float,
    out: wp.array[float],
): ...


@wp.kernel
def guidance_mix(
    start: int,
    # In:
    span: int,
    negative: wp.array[float],
    positive: wp.array[float],
    scale: float,
    # Out:
    mix_out: wp.array[float],
):
    """Classifier-free guidance: e_neg + scale (e_pos - e_neg) (Ho and Salimans 2022, eq. 6)."""
    guidance_span(start + wp.tid(), span, negative, positive, scale, mix_out)


_RESIDUAL = """
        const float r = weight * (x.data[i] - y.data[i]);
        const bool finite = r - r == 0.0f;
        out.data[i] = finite ? r : 0.0f;
        invalid += finite ? 0 : 1;
"""


@wp.func_native("int invalid = 0;" + _loop(_RESIDUAL) + "    invalid_out.data[index] = invalid;\n")
def residual_span(
    index: int,
    span: int,
    x: wp.array[float],
    y: wp.array[float],
    weight: float,
    out: wp.array[float],
    invalid_out: wp.array[int],
): ...


@wp.kernel
def weighted_residual(
    start: int,
    # In:
    span: int,
    minuend: wp.array[float],
    subtrahend: wp.array[float],
    weight: float,
    # Out:
    residual_out: wp.array[float],
    invalid_out: wp.array[int],
):
    """weight (minuend - subtrahend), zero where that is not finite; and how many were not, for each span."""
    residual_span(start + wp.tid(), span, minuend, subtrahend, weight, residual_out, invalid_out)
