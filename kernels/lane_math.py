"""C++ text: elementary functions of vectors of lanes, for snippets that begin with `lanes.PRELUDE`.

    rsqrt_(v)          1 / sqrt(v), v > 0
    log_(u), log1p_(x) natural logarithms, u > 0, x > -1
    log_of(u, x)       log u, where x = u - 1 is known better than u
    exp_(x), expm1_(x) of x within [-80, 80], beyond that of the nearer end
    angle_(y, x)       of the point (x, y), y >= 0, in [0, pi]
    cos_(x), sin_(x)   of x in [0, pi/3]

All to a few units of the last place (relative; `angle_` to 1e-7), for numbers that are not denormal.
"""

from __future__ import annotations

LANE_MATH = """
    // 1 / sqrt(v) to an ulp or two, v > 0.
    auto rsqrt_ = [&](F v) {
#if defined(__CUDACC__)
        return rsqrtf(v);
#elif defined(__AVX512F__)
        const F y = (F)__builtin_ia32_rsqrt14ps512_mask(v, v, (unsigned short)0xffff);
        const F r = 1.0f - v * y * y;
        return y + y * r * (0.5f + 0.375f * r);
#else
        return 1.0f / sqrt_(v);
#endif
    };
    // log u, where x = u - 1 is known better than u.
    auto log_of = [&](F u, F x) {
        const I shifted = bits_of(u) - 0x3f3504f3;
        const I n = shifted >> 23;
        const F m = of_bits((shifted & 0x007fffff) + 0x3f3504f3);
        const F f = select(n == 0, x, m - 1.0f);
        const F t = f / (f + 2.0f), q = t * t;
        const F series = (((q * 0.22222222f + 0.28571429f) * q + 0.4f) * q + 0.66666667f) * q + 2.0f;
        return to_float(n) * 0.69314718f + t * series;
    };
    auto log1p_ = [&](F x) { return log_of(x + 1.0f, x); };
    auto log_ = [&](F u) { return log_of(u, u - 1.0f); };
    auto expm1_ = [&](F v) {
        const F x = max_(min_(v, splat(80.0f)), splat(-80.0f));
        const F n = floor_(x * 1.4426950f + 0.5f);
        const F r = (x - n * 0.69314575f) - n * 1.4286068e-6f;
        F p = r * (1.0f / 7.0f) + 1.0f;
        p = p * r * (1.0f / 6.0f) + 1.0f;
        p = p * r * (1.0f / 5.0f) + 1.0f;
        p = p * r * (1.0f / 4.0f) + 1.0f;
        p = p * r * (1.0f / 3.0f) + 1.0f;
        p = p * r * 0.5f + 1.0f;
        const F power = of_bits((to_int(n) + 127) << 23);
        return power * (p * r) + (power - 1.0f);
    };
    auto exp_ = [&](F x) { return expm1_(x) + 1.0f; };
    // Angle of the point (x, y), y >= 0.
    auto angle_ = [&](F y, F x) {
        const F a = abs_(x), high = max_(a, y), low = min_(a, y);
        const F t = low / select(high > 0.0f, high, splat(1.0f)), q = t * t;
        F p = q * 0.0028340643f - 0.016005031f;
        p = p * q + 0.042587608f;
        p = p * q - 0.074954454f;
        p = p * q + 0.10636754f;
        p = p * q - 0.14202571f;
        p = p * q + 0.19992484f;
        p = p * q - 0.33333067f;
        const F first = t + t * q * p;
        const F steep = select(y > a, 1.5707963f - first, first);
        return select(x < 0.0f, 3.1415927f - steep, steep);
    };
    // Of angles from 0 to 60 degrees.
    auto cos_ = [&](F x) {
        const F q = x * x;
        F p = q * -2.7557319e-7f + 2.4801587e-5f;
        p = p * q - 1.3888889e-3f;
        p = p * q + 4.1666667e-2f;
        p = p * q - 0.5f;
        return p * q + 1.0f;
    };
    auto sin_ = [&](F x) {
        const F q = x * x;
        F p = q * -2.5052108e-8f + 2.7557319e-6f;
        p = p * q - 1.9841270e-4f;
        p = p * q + 8.3333333e-3f;
        p = p * q - 0.16666667f;
        return x + x * (p * q);
    };
"""

__all__ = ["LANE_MATH"]
