"""The kernel of `vsf.dynamics`: one thread moves one particle through all substeps of a touch.

All positions are in the probe's frame, in which the surface is fixed and the particle's rest position y moves. With the
signed distance phi and its outward normal n, the spring force on a particle at p on the surface is along y - p. The
particle minimises |p - y|^2 / 2 over the surface under friction: it sticks while |u_t| <= mu u.n, u = p - y.
"""

import warp as wp

from vsfsim.physics.contact.sdf import analytic_gap as distance
from vsfsim.physics.contact.sdf import analytic_normal as normal
from vsfsim.physics.contact.sdf import vec4
from vsfsim.physics.runtime import mat33, real, vec3

# The caller that shows progress reports compilation, so Warp's own messages are off.
if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING


# No unrolling: the unrolled kernel takes three times as long to compile and is not faster.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

halvings = wp.constant(48)  # they reduce a bracket to the last digits
slack = wp.constant(wp.float64(1e-12))  # of the cone: rounding error of a tangential force that should be zero
small = wp.constant(wp.float64(1e-13))  # excess at which a slide has ended, over the tangential force before it
# Length of the step that tests whether the spring force points out of the probe, over the displacement.
test_step = wp.constant(wp.float64(1e-5))


@wp.func
def on_surface(kind: int, size: vec4, p: vec3) -> vec3:
    """The nearest point of the surface."""
    return p - distance(kind, size, p) * normal(kind, size, p)


@wp.func
def excess(kind: int, size: vec4, mu: real, y: vec3, p: vec3, t: vec3) -> real:
    """Tangential force along ``t`` minus the friction limit, over the spring constant; positive: it slides."""
    n = normal(kind, size, p)
    u = p - y
    along = t - wp.dot(t, n) * n
    size_along = wp.length(along)
    if size_along > real(0.0):
        along = along / size_along
    return -wp.dot(u, along) - mu * wp.max(wp.dot(u, n), real(0.0))


@wp.func
def detaches(kind: int, size: vec4, y: vec3, p: vec3) -> bool:
    """Whether a short step along the spring force leads out of the probe (also on an edge)."""
    pull = y - p
    ahead = p + test_step * pull
    return distance(kind, size, ahead) >= distance(kind, size, p)


@wp.func
def slid(kind: int, size: vec4, mu: real, y: vec3, start: vec3) -> vec3:
    """Where a particle at ``start`` on the surface comes to rest; ``y`` is the other end of its spring."""
    p = start
    # A plane, a sphere and a flat face need one iteration, because the force keeps its tangent direction. An edge,
    # or the lateral surface of a cylinder that is oblique to the force, needs a few.
    for _turn in range(12):
        n = normal(kind, size, p)
        u = p - y
        un = wp.dot(u, n)
        ut = u - un * n
        length = wp.length(ut)
        if un <= real(0.0) or length <= mu * un + slack * wp.length(u):
            return p
        t = -ut / length
        low = real(0.0)
        high = length
        # The force points into the probe, so its tangential part vanishes further along; double the bracket until
        # it has.
        at_low = length - mu * un
        at_high = excess(kind, size, mu, y, on_surface(kind, size, p + high * t), t)
        for _widen in range(6):
            if at_high > real(0.0):
                low = high
                at_low = at_high
                high = high * real(2.0)
                at_high = excess(kind, size, mu, y, on_surface(kind, size, p + high * t), t)
        # Regula falsi, in which an end that stays weighs half (Illinois): some ten steps where bisection takes all.
        stayed = wp.int32(0)
        for _step in range(halvings):
            middle = real(0.5) * (low + high)
            if at_low - at_high > real(0.0):
                chord = low + (high - low) * (at_low / (at_low - at_high))
                if chord > low and chord < high:
                    middle = chord
            at = excess(kind, size, mu, y, on_surface(kind, size, p + middle * t), t)
            if at > real(0.0):
                low = middle
                at_low = at
                if stayed == 1:
                    at_high = real(0.5) * at_high
                stayed = 1
            else:
                high = middle
                at_high = at
                if stayed == 2:
                    at_low = real(0.5) * at_low
                stayed = 2
            if at <= real(0.0) and at >= -small * length:
                break
        q = on_surface(kind, size, p + high * t)
        if wp.length_sq(q - y) >= wp.length_sq(u):
            return p
        p = q
    return p

@wp.kernel(enable_backward=False)
def stick_slip(
    # model
    kind: int,
    size: vec4,
    friction: real,
    # state in
    rotation_in: wp.array(dtype=mat33),
    origin_in: wp.array(dtype=vec3),
    frame_in: wp.array(dtype=wp.int32),
    rest_in: wp.array(dtype=vec3),
    # state out
    displacement_out: wp.array2d(dtype=vec3),
):
    i = wp.tid()
    rest = rest_in[i]
    y = wp.transpose(rotation_in[0]) * (rest - origin_in[0])
    phi = distance(kind, size, y)
    held = phi < real(0.0)
    p = y
    if held:
        p = on_surface(kind, size, y)
        displacement_out[0, i] = rotation_in[0] * (p - y)
    for s in range(1, rotation_in.shape[0]):
        y_before = y
        phi_before = phi
        y = wp.transpose(rotation_in[s]) * (rest - origin_in[s])
        phi = distance(kind, size, y)
        if not held and phi < real(0.0):
            # The rest position entered along y_before -> y: the particle sticks to the point of entry.
            low = real(0.0)
            high = real(1.0)
            if phi_before > real(0.0):
                for _halve in range(halvings):
                    middle = real(0.5) * (low + high)
                    if distance(kind, size, y_before + middle * (y - y_before)) > real(0.0):
                        low = middle
                    else:
                        high = middle
            else:
                high = real(0.0)
            p = on_surface(kind, size, y_before + high * (y - y_before))
            held = True
        if held:
            if detaches(kind, size, y, p):
                held = False
            else:
                p = slid(kind, size, friction, y, p)
                if detaches(kind, size, y, p):
                    held = False
            # Detached, but by rounding the rest position is still inside: stay on the surface.
            if not held and phi < real(0.0):
                p = on_surface(kind, size, y)
                held = True
        frame = frame_in[s]
        if frame >= 0 and held:
            displacement_out[frame, i] = rotation_in[s] * (p - y)
