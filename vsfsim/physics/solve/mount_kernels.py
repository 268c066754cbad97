"""The kernels that move bodies on springs to where these are in balance with the contact: `mount`."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from vsfsim.physics.runtime import real, vec3

# difference between the contact's force and the spring's, over the force, that ends the search: what is left must not
# show in differences of potentials
_EXACT = wp.constant(real(1e-7))
_FAR = wp.constant(real(0.5))  # of it over the spring's force: from here on the force goes with the square of the depth
_TOUCH = wp.constant(real(1e-7))  # how far the probe goes in past its first contact [m]


@functools.cache
def kernels() -> Any:
    """The kernels that move bodies on springs, one thread a touch."""
    module = "vsfsim_mount"

    @wp.kernel(module=module, enable_backward=False)
    def place(
        # model
        columns: wp.array(dtype=wp.int32),
        press: wp.array(dtype=vec3),
        # state in
        mounts: wp.array2d(dtype=vec3),
        # state out
        settling_out: wp.array(dtype=wp.int32),
        give_out: wp.array(dtype=real),
        excess_out: wp.array(dtype=real),
        low_out: wp.array(dtype=real),
        high_out: wp.array(dtype=real),
        origin_out: wp.array2d(dtype=vec3),
    ):
        # bodies where springs let them
        k = wp.tid()
        b = columns[k]
        settling_out[b] = 1
        low_out[b] = -real(wp.inf)
        high_out[b] = real(wp.inf)
        for j in range(mounts.shape[1]):
            origin_out[b, j] = mounts[b, j] - give_out[b] * press[b]

    @wp.kernel(module=module, enable_backward=False)
    def settle(
        # model
        columns: wp.array(dtype=wp.int32),
        press: wp.array(dtype=vec3),
        stiffness: real,
        last: int,
        # state in
        mounts: wp.array2d(dtype=vec3),
        pressed: wp.array2d(dtype=vec3),
        # state out
        settling_out: wp.array(dtype=wp.int32),
        give_out: wp.array(dtype=real),
        excess_out: wp.array(dtype=real),
        low_out: wp.array(dtype=real),
        high_out: wp.array(dtype=real),
        origin_out: wp.array2d(dtype=vec3),
    ):
        # a step of `Springs.settle`
        b = columns[wp.tid()]
        if settling_out[b] == 0:
            return
        pull, slope, apart = real(0.0), real(0.0), real(1e30)
        for f in range(pressed.shape[1]):
            pull += pressed[b, f][0]
            slope += pressed[b, f][1]
            apart = wp.min(apart, pressed[b, f][2])
        w = give_out[b]
        excess = pull - stiffness * w
        excess_out[b] = excess
        if last != 0 or wp.abs(excess) <= _EXACT * wp.max(wp.abs(pull), stiffness * wp.abs(w)):
            settling_out[b] = 0
            return
        if excess > real(0.0):
            low_out[b] = w
        if excess < real(0.0):
            high_out[b] = w
        both = slope + stiffness
        square = real(0.0)
        if wp.abs(excess) > _FAR * stiffness * wp.abs(w) and pull > real(0.0):
            square = slope * slope / pull
        new = w + real(2.0) * excess / (both + wp.sqrt(wp.max(both * both - square * excess, real(0.0))))
        if apart >= real(0.0):
            new = real(0.0)
            if w > real(0.0):
                new = w + wp.max(-apart - _TOUCH, -w)
        middle = real(0.5) * (low_out[b] + high_out[b])
        if not (new > low_out[b] and new < high_out[b]) and wp.isfinite(middle):
            new = middle
        give_out[b] = new
        for j in range(mounts.shape[1]):
            origin_out[b, j] = mounts[b, j] - new * press[b]

    return SimpleNamespace(place=place, settle=settle)
