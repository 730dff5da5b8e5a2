"""C++ text for CPU tile kernels: whole images in and out of vectors of 16 pixels.

`IMAGES`, after LOCATE_TILE and TILE_LANES of `gdpro_sim.kernels.compositing`, defines for images [C, H, W, n]
with n <= 4 interleaved channels

    write_image(image, n, planes)   planes[i][k], channel i of the tile's block k, to the image
    read_image(image, n, planes)    the other way; zero outside the image
    fetch_image(image, n)           brings what will be written to the cache meanwhile

Values travel in vectors and are interleaved by shuffles: lane by lane it would take longer than blending
does.
"""

from __future__ import annotations


def _numbers(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers))


def _store_row(row: int, n: int) -> str:
    """Four pixels of channels v0 .. to p[0 .. 4 n - 1]."""
    of = [4 * row + i // n for i in range(4 * n)]
    spare = [-1] * (16 - 4 * n)
    if n == 1:
        take = f"__builtin_shufflevector(v0, v0, {_numbers([*of, *spare])})"
    else:
        low = [o + 16 * (i % n) if i % n < 2 else -1 for i, o in enumerate(of)]
        take = f"__builtin_shufflevector(v0, v1, {_numbers([*low, *spare])})"
        if n == 3:
            both = [i if i % n < 2 else 16 + o for i, o in enumerate(of)]
            take = f"__builtin_shufflevector({take}, v2, {_numbers([*both, *spare])})"
        if n == 4:
            high = [o + 16 * (i % n - 2) if i % n >= 2 else -1 for i, o in enumerate(of)]
            other = f"__builtin_shufflevector(v2, v3, {_numbers(high)})"
            both = [i if i % n < 2 else 16 + i for i in range(16)]
            take = f"__builtin_shufflevector({take}, {other}, {_numbers(both)})"
    return f"""
            {{ const F v = {take}; __builtin_memcpy(p + {row} * stride, &v, {16 * n}); }}"""


def _store(n: int) -> str:
    return "".join(_store_row(row, n) for row in range(4))


def _load(n: int) -> str:
    """Four rows of 4 n floats from p on to channels of block k."""
    text = "".join(
        f"""
            __builtin_memcpy(&r{row}, p + {row} * stride, {16 * n});"""
        for row in range(4)
    )
    for channel in range(n):
        first = [n * i + channel for i in range(4)]
        pair = [*first, *(16 + f for f in first), *[-1] * 8]
        text += f"""
            planes[{channel}][k] = __builtin_shufflevector(
                __builtin_shufflevector(r0, r1, {_numbers(pair)}),
                __builtin_shufflevector(r2, r3, {_numbers(pair)}),
                {_numbers([*range(8), *range(16, 24)])});"""
    return text


def _cases(texts: dict[int, str]) -> str:
    return "".join(
        f"""
        case {n}: {{{text}
            break; }}"""
        for n, text in texts.items()
    )


IMAGES = f"""
    const bool cropped = x_end < 16 || y_end < 16;
    const size_t origin = ((size_t)camera * height + tile_y) * width + tile_x;
    auto store_block = [&](float* p, int stride, int n, F v0, F v1, F v2, F v3) {{
        switch (n) {{{_cases({n: _store(n) for n in (1, 2, 3, 4)})}
        }}
    }};
    auto fetch_image = [&](const float* image, int n) {{
        for (int y = 0; y < y_end; ++y) {{
            const float* const row = image + (origin + (size_t)y * width) * n;
            for (int i = 0; i < n; ++i) __builtin_prefetch(row + 16 * i, 1);
        }}
    }};
    auto write_image = [&](float* image, int n, const F* const* planes) {{
        float staged[1024];
        float* const to = cropped ? staged : image + origin * n;
        const int stride = (cropped ? 16 : width) * n;
        for (int k = 0; k < 16; ++k) {{
            store_block(to + (k >> 2) * 4 * stride + (k & 3) * 4 * n, stride, n, planes[0][k],
                planes[n > 1 ? 1 : 0][k], planes[n > 2 ? 2 : 0][k], planes[n > 3 ? 3 : 0][k]);
        }}
        for (int y = 0; cropped && y < y_end; ++y) {{
            float* const row = image + (origin + (size_t)y * width) * n;
            for (int i = 0; i < x_end * n; ++i) row[i] = staged[y * stride + i];
        }}
    }};
    auto read_image = [&](const float* image, int n, F* const* planes) {{
        float staged[1024];
        const float* const from = cropped ? staged : image + origin * n;
        const int stride = (cropped ? 16 : width) * n;
        for (int i = 0; cropped && i < 256 * n; ++i) {{
            const int y = i / stride, x = i - y * stride;
            staged[i] = y < y_end && x < x_end * n ? image[(origin + (size_t)y * width) * n + x] : 0.0f;
        }}
        for (int k = 0; k < 16; ++k) {{
            const float* const p = from + (k >> 2) * 4 * stride + (k & 3) * 4 * n;
            F r0 = zero, r1 = zero, r2 = zero, r3 = zero;
            switch (n) {{{_cases({n: _load(n) for n in (1, 2, 3, 4)})}
            }}
        }}
    }};
"""

__all__ = ["IMAGES"]
