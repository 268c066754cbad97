"""The lanes that one touch is worked on by: the 32 threads of a GPU's warp, or one thread of a CPU.

All lanes of a touch run through the same code; a loop over nodes or contacts is shared out, lane k takes every 32nd
from k on, and `meet` stands between what is written and what other lanes read.
A decision is taken on numbers that all lanes have alike, so none of them ever waits alone. Sums over lanes have a fixed
order: the same bits on every run.
A block is one touch, so Warp's barrier of a block is all that is needed; with one lane everything here is nothing.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

LANES = 32  # of a touch on a GPU


@wp.func_native(snippet="""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#else
    WP_TILE_SYNC();
#endif
""")
def meet():
    """What any lane wrote before, all lanes see after."""
    ...


def _folded(kind: str, join: str) -> str:
    """A number of every lane joined in a butterfly; on a CPU with more than one lane (tests) through a box that they
    share."""
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
def total(x: wp.float64) -> wp.float64:
    """Sum over the lanes."""
    ...


@wp.func_native(snippet=_folded("double", "v > u || u != u ? v : u"))
def most(x: wp.float64) -> wp.float64:
    """Largest of the lanes' numbers; what is no number is left out, so that all lanes have the same."""
    ...


@wp.func_native(snippet=_folded("int", "v + u"))
def count_all(x: wp.int32) -> wp.int32:
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
def ahead(x: wp.int32) -> wp.int32:
    """Sum over the lanes before this one."""
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
def late(clock: wp.array(dtype=wp.uint64), span: wp.int64) -> wp.int32:
    """1 once ``span`` [ns] have gone since the launch first asked; ``clock`` (1,) is 0 before it. On a CPU, and without
    a span, never: there the iterations are counted. It decides where a launch stops, no bit depends on it."""
    ...
