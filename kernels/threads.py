"""Pieces of a CPU launch, taken by threads as they come free without going back to Python between them.

`job` [JOB] numbers are shared by all threads, each group on a cache line of its own:

    TICKET              number of the launch in the upper 32 bits, pieces left to take in the lower
    DONE                pieces done
    AWAKE               threads in `serve`
    FUNCTION .. COUNT   address of the compiled kernel, of the pieces' launch bounds and arguments (each an
                        array of addresses), and how many pieces there are

A piece is taken by lowering the ticket. Whoever has taken one may read the rest of the job until it is done:
the next job begins only after that.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

JOB = 32
"""Numbers of a job."""

DONE = 8

AWAKE = 16

COUNT = 27

_JOB = """
    unsigned long long* const ticket = (unsigned long long*)job.data;
    unsigned long long* const finished = ticket + 8;
    unsigned long long* const awake = ticket + 16;
    unsigned long long* const what = ticket + 24;  // function, bounds, arguments, count
    auto rest = []() {
#if defined(__x86_64__)
        __builtin_ia32_pause();
#elif defined(__aarch64__)
        __asm__ volatile("yield");
#endif
    };
    auto waits = [&]() { return (__atomic_load_n(ticket, __ATOMIC_SEQ_CST) & 0xffffffffull) != 0; };
    auto work = [&]() {
        typedef void (*Piece)(void*, void*);
        unsigned long long now = __atomic_load_n(ticket, __ATOMIC_ACQUIRE);
        while (now & 0xffffffffull) {
            if (!__atomic_compare_exchange_n(
                    ticket, &now, now - 1, false, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE)) continue;
            const unsigned long long i = what[3] - (now & 0xffffffffull);
            ((Piece)what[0])(((void**)what[1])[i], ((void**)what[2])[i]);
            __atomic_fetch_add(finished, 1, __ATOMIC_RELEASE);
            now = __atomic_load_n(ticket, __ATOMIC_ACQUIRE);
        }
    };
    auto wait = [&](int rests) {
        for (int i = 0; i < rests; ++i) {
            if (__atomic_load_n(finished, __ATOMIC_ACQUIRE) == what[3]) return;
            rest();
        }
    };
"""


@wp.func_native(f"""
#if !defined(__CUDACC__)
    {_JOB}
    __atomic_fetch_add(awake, 1, __ATOMIC_SEQ_CST);
    for (;;) {{
        for (int i = 0; i < rests; ++i) {{
            if (waits()) {{
                work();
                i = 0;
            }}
            rest();
        }}
        __atomic_fetch_sub(awake, 1, __ATOMIC_SEQ_CST);
        // A job given out before this is seen here; who gives out a later one sees this thread asleep.
        if (!waits()) return;
        __atomic_fetch_add(awake, 1, __ATOMIC_SEQ_CST);
    }}
#endif
""")
def serve_job(job: wp.array[wp.uint64], rests: int): ...


@wp.kernel
def serve(job: wp.array[wp.uint64], rests: int):
    """Take pieces of any job until none has come for `rests` pauses of the processor."""
    serve_job(job, rests)


@wp.func_native(f"""
#if !defined(__CUDACC__)
    {_JOB}
    what[0] = function, what[1] = bounds, what[2] = arguments, what[3] = (unsigned long long)count;
    __atomic_store_n(finished, 0, __ATOMIC_RELAXED);
    const unsigned long long number = (*ticket >> 32) + 1;
    __atomic_store_n(ticket, (number << 32) | (unsigned)count, __ATOMIC_SEQ_CST);
#endif
""")
def give_job(
    job: wp.array[wp.uint64], function: wp.uint64, bounds: wp.uint64, arguments: wp.uint64, count: int
): ...


@wp.kernel
def give(job: wp.array[wp.uint64], function: wp.uint64, bounds: wp.uint64, arguments: wp.uint64, count: int):
    """Give out a job: whoever is awake begins. Only then look how many are."""
    give_job(job, function, bounds, arguments, count)


@wp.func_native(f"""
#if !defined(__CUDACC__)
    {_JOB}
    work();
    wait(rests);
#endif
""")
def join_job(job: wp.array[wp.uint64], rests: int): ...


@wp.kernel
def join(job: wp.array[wp.uint64], rests: int):
    """Take pieces until none is left; then wait for the others' pieces, for at most `rests` pauses."""
    join_job(job, rests)


@wp.func_native("""
#if !defined(__CUDACC__)
    typedef void (*Piece)(void*, void*);
    for (int i = 0; i < count; ++i) ((Piece)function)(((void**)bounds)[i], ((void**)arguments)[i]);
#endif
""")
def run_pieces(function: wp.uint64, bounds: wp.uint64, arguments: wp.uint64, count: int): ...


@wp.kernel
def run_alone(function: wp.uint64, bounds: wp.uint64, arguments: wp.uint64, count: int):
    """All pieces of a job, one after the other."""
    run_pieces(function, bounds, arguments, count)
