"""Orders by depth on a CPU: a radix sort of (key, number) pairs, stable, by 11 bits of the key at a time.

Keys are non-negative floats, infinity included, whose bits are in the order of their values. One index sorts
them all (`sort_alone`), or each of `parts` ranges of them counts its digits and then moves its pairs
(`count_digits`, `move_pairs`), once for each digit. Both give the same order.

    keys       [N]
    order_out  [N] numbers, sorted in place
    pairs_out  [2, N] scratch
"""

import warp as wp

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": "-march=native",
    }
)

DIGITS = 3
"""Digits of a key, from the last: 33 bits are enough for floats without sign."""

BUCKETS = 2048

_READ = f"""
    typedef unsigned long long Pair;
    auto digit = [](Pair pair, int number) {{ return (int)(pair >> (32 + 11 * number)) & {BUCKETS - 1}; }};
    const int count = keys.shape[0];
    const unsigned* const key = (const unsigned*)keys.data;
    int* const place = order_out.data;
    Pair* const scratch[2] = {{(Pair*)pairs_out.data, (Pair*)pairs_out.data + count}};
    // Digit 0 is read from keys and order and the last written to the order: pairs lie between.
    auto read = [&](int number, int i) {{
        return number == 0 ? (Pair)key[i] << 32 | (unsigned)place[i] : scratch[(number - 1) & 1][i];
    }};
    auto move = [&](int number, int begin, int end, int* next) {{
        for (int i = begin; i < end; ++i) {{
            const Pair pair = read(number, i);
            const int at = next[digit(pair, number)]++;
            if (number == {DIGITS - 1}) place[at] = (int)(unsigned)pair;
            else scratch[number & 1][at] = pair;
        }}
    }};
"""
"""Snippet: arrays -> count, digit, read, move."""

_RANGE = """
    const int begin = (int)((long long)count * part / parts),
        end = (int)((long long)count * (part + 1) / parts);
"""


@wp.func_native(f"""
{_READ}
    int counts[{DIGITS}][{BUCKETS}] = {{}};
    for (int i = 0; i < count; ++i) {{
        const Pair pair = read(0, i);
        for (int number = 0; number < {DIGITS}; ++number) ++counts[number][digit(pair, number)];
    }}
    for (int number = 0; number < {DIGITS}; ++number) {{
        int sum = 0;
        for (int i = 0; i < {BUCKETS}; ++i) {{
            const int here = counts[number][i];
            counts[number][i] = sum;
            sum += here;
        }}
        move(number, 0, count, counts[number]);
    }}
""")
def sort_all(keys: wp.array[float], order_out: wp.array[int], pairs_out: wp.array2d[wp.int64]): ...


@wp.kernel
def sort_alone(start: int, keys: wp.array[float], order_out: wp.array[int], pairs_out: wp.array2d[wp.int64]):
    """Sort all numbers; one index does it."""
    sort_all(keys, order_out, pairs_out)


@wp.func_native(f"""
{_READ}{_RANGE}
    int* const counts = counts_out.data + (size_t)part * {BUCKETS};
    for (int i = 0; i < {BUCKETS}; ++i) counts[i] = 0;
    for (int i = begin; i < end; ++i) ++counts[digit(read(number, i), number)];
""")
def count_part(
    part: int,
    parts: int,
    number: int,
    keys: wp.array[float],
    order_out: wp.array[int],
    pairs_out: wp.array2d[wp.int64],
    counts_out: wp.array2d[int],
): ...


@wp.kernel
def count_digits(
    start: int,
    # In:
    parts: int,
    number: int,
    keys: wp.array[float],
    order: wp.array[int],
    pairs: wp.array2d[wp.int64],
    # Out:
    counts_out: wp.array2d[int],
):
    """How often each value of digit `number` occurs in one part: counts_out [parts, BUCKETS]."""
    count_part(start + wp.tid(), parts, number, keys, order, pairs, counts_out)


@wp.func_native(f"""
{_READ}{_RANGE}
    int next[{BUCKETS}], sum = 0;
    for (int i = 0; i < {BUCKETS}; ++i) {{
        int before = sum;
        for (int other = 0; other < parts; ++other) {{
            const int here = counts.data[(size_t)other * {BUCKETS} + i];
            if (other < part) before += here;
            sum += here;
        }}
        next[i] = before;
    }}
    move(number, begin, end, next);
""")
def move_part(
    part: int,
    parts: int,
    number: int,
    keys: wp.array[float],
    order_out: wp.array[int],
    pairs_out: wp.array2d[wp.int64],
    counts: wp.array2d[int],
): ...


@wp.kernel
def move_pairs(
    start: int,
    # In:
    parts: int,
    number: int,
    keys: wp.array[float],
    # Out:
    order_out: wp.array[int],
    pairs_out: wp.array2d[wp.int64],
    # In:
    counts: wp.array2d[int],
):
    """Move the pairs of one part to where digit `number` puts them."""
    move_part(start + wp.tid(), parts, number, keys, order_out, pairs_out, counts)
