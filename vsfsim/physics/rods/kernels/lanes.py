"""The lanes of a touch: the 32 threads of a warp on a GPU, or one thread on a CPU.

All lanes of a touch execute the same code. Loops over nodes or contacts are distributed: lane k takes every 32nd item
from k on, and `sync` separates writes from reads by other lanes. Branches depend only on values that all lanes share,
so no lane waits alone at a barrier. Reductions over the lanes have a fixed order, so every run gives the same bits.
A thread block holds one touch, so Warp's barrier of a block suffices; with one lane all functions here are trivial.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly

LANES = 32  # of a touch on a GPU


@wp.func_native(snippet="""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#else
    WP_TILE_SYNC();
#endif
""")
def sync():
    """Barrier: what a lane wrote before it, all lanes read after it."""
    ...


def _folded(kind: str, join: str) -> str:
    """Source of a butterfly reduction over the lanes; with several lanes on a CPU (tests) it uses a shared array."""
    return f"""
    {kind} v = x;
#if defined(__CUDA_ARCH__)
    for (int s = 16; s > 0; s >>= 1) {{
        {kind} u = __shfl_xor_sync(0xffffffffu, v, s);
        v = {join};
    }}
#elif WP_TILE_BLOCK_DIM > 1
    static {kind} box[2][32];
    const int me = WP_TILE_THREAD_IDX;
    for (int s = 16; s > 0; s >>= 1) {{
        box[0][me] = v;
        WP_TILE_SYNC();
        {kind} u = box[0][me ^ s];
        v = {join};
        WP_TILE_SYNC();
    }}
#endif
    return v;
"""


@wp.func_native(snippet=_folded("double", "v + u"))
def lane_sum(x: wp.float64) -> wp.float64:
    """Sum over the lanes."""
    ...


@wp.func_native(snippet=_folded("double", "v > u || u != u ? v : u"))
def lane_max(x: wp.float64) -> wp.float64:
    """Maximum over the lanes. NaN is ignored, so that all lanes get the same value."""
    ...


@wp.func_native(snippet=_folded("int", "v + u"))
def lane_count(x: wp.int32) -> wp.int32:
    """Sum over the lanes."""
    ...


@wp.func_native(snippet="""
    int v = 0;
#if defined(__CUDA_ARCH__)
    const int me = threadIdx.x & 31;
    int u = x;
    for (int s = 1; s < 32; s <<= 1) {
        const int other = __shfl_up_sync(0xffffffffu, u, s);
        if (me >= s)
            u += other;
    }
    v = u - x;
#elif WP_TILE_BLOCK_DIM > 1
    static int box[32];
    const int me = WP_TILE_THREAD_IDX;
    box[me] = x;
    WP_TILE_SYNC();
    for (int k = 0; k < me; ++k)
        v += box[k];
    WP_TILE_SYNC();
#endif
    return v;
""")
def lanes_before(x: wp.int32) -> wp.int32:
    """Sum over the lanes before this one (exclusive prefix sum)."""
    ...


@wp.func_native(snippet="""
#if defined(__CUDA_ARCH__)
    if (span <= 0)
        return 0;
    unsigned long long now;
    asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(now));
    const unsigned long long first = atomicCAS((unsigned long long*)clock.data, 0ull, now);
    const int over = first != 0ull && now > first + (unsigned long long)span;
    return __shfl_sync(0xffffffffu, over, 0);
#else
    return 0;
#endif
""")
def time_is_up(clock: wp.array(dtype=wp.uint64), span: wp.int64) -> wp.int32:
    """1 when ``span`` [ns] have passed since the first call of the launch, for which ``clock`` (1,) must be 0.

    On a CPU, and for a span of 0, the answer is always 0: the host limits the iterations there. The answer only decides
    where a launch stops; the results do not depend on it."""
    ...
