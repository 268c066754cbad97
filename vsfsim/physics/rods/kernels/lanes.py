"""The lanes of a touch: the 32 threads of a warp on a GPU, or one thread on a CPU.

All lanes of a touch execute the same code. Loops over nodes or contacts are distributed: lane k takes every 32nd item
from k on, and `sync` separates writes from reads by other lanes. Branches depend only on values that all lanes share,
so no lane waits alone at a barrier. Reductions over the lanes have a fixed order, so every run gives the same bits.
With one lane all functions here are trivial.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly

LANES = 32  # of a touch on a GPU


@wp.func_native(snippet="""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def sync():
    """Barrier: what a lane wrote before it, all lanes read after it."""
    ...


def _folded(kind: str, join: str) -> str:
    """Source of a butterfly reduction over the lanes."""
    return f"""
    {kind} v = x;
#if defined(__CUDA_ARCH__)
    for (int s = 16; s > 0; s >>= 1) {{
        {kind} u = __shfl_xor_sync(0xffffffffu, v, s);
        v = {join};
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
#endif
    return v;
""")
def lanes_before(x: wp.int32) -> wp.int32:
    """Sum over the lanes before this one (exclusive prefix sum)."""
    ...
