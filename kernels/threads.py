"""Pieces of a CPU launch handed to threads as they come free, without going back to Python between them."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if !defined(__CUDACC__)
    typedef void (*Piece)(void*, void*);
    const Piece piece = (Piece)(size_t)function;
    for (;;) {
        const int i = __atomic_fetch_add(counter.data, 1, __ATOMIC_RELAXED);
        if (i >= count) break;
        piece((void*)(size_t)bounds.data[i], (void*)(size_t)arguments.data[i]);
    }
#endif
""")
def take_pieces(
    count: int,
    function: wp.uint64,
    bounds: wp.array[wp.uint64],
    arguments: wp.array[wp.uint64],
    counter: wp.array[int],
):
    """See `run_pieces`."""
    ...


@wp.kernel
def run_pieces(
    count: int,
    function: wp.uint64,
    bounds: wp.array[wp.uint64],
    arguments: wp.array[wp.uint64],
    counter: wp.array[int],
):
    """Call a compiled kernel for pieces `counter[0]` and on, as other threads do too, until `count` are done.

    function:          its address
    bounds, arguments: [count] addresses of what each piece is called with
    """
    take_pieces(count, function, bounds, arguments, counter)
