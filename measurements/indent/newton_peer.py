"""The press in Newton: vertex block descent on linear tetrahedra, stable neo-Hookean (Smith 2018), a penalty at nodes.

Runs in a venv of its own with newton; nothing of vsfsim is imported. A frame is steps that are so long that inertia has
no part, of `SWEEPS` sweeps over all nodes each, until the force is settled or `MOST` sweeps are made. The force is the
sum over the nodes in the ball of the penalty; what is unbalanced is its difference from the force on the base, which is
computed from the nodes' places.
"""

import newton
import numpy as np
import warp as wp

SWEEPS = 100
MOST = 1600
SETTLED = 0.01  # unbalanced force over the contact force [-]
STEP = 10.0  # [s]
STIFF = 20.0  # contact of a node over the modulus times an edge [-]
NEAR = 0.002  # distance from which nodes are tested for contact [m]
SHELL = 1e-5  # radius of a node [m]


def base_force(x: np.ndarray, rest: np.ndarray, tets: np.ndarray, mu: np.ndarray, lam: np.ndarray,
               held: np.ndarray) -> float:
    """Force of the tetrahedra on the nodes that are held, along z [N]."""
    back = np.linalg.inv(np.swapaxes(rest[tets[:, 1:]] - rest[tets[:, :1]], 1, 2))
    volume = 1.0 / np.abs(np.linalg.det(back)) / 6.0
    f = np.swapaxes(x[tets[:, 1:]] - x[tets[:, :1]], 1, 2) @ back
    j = np.linalg.det(f)
    cofactor = j[:, None, None] * np.swapaxes(np.linalg.inv(f), 1, 2)
    other = lam + mu  # of the energy in place of Lame's, see Smith 2018, section 3.4
    stress = mu[:, None, None] * f + (other * (j - 1.0 - mu / other))[:, None, None] * cofactor
    force = volume[:, None, None] * stress @ np.swapaxes(back, 1, 2)  # on the last three corners
    total = np.zeros(len(x))
    np.add.at(total, tets[:, 1:], force[:, 2, :])
    np.add.at(total, tets[:, 0], -force[:, 2, :].sum(axis=1))
    return float(total[held].sum())


def make(given):
    """See `measurements.indent.pressing`."""
    points, tets, radius = given["points"], given["tets"], float(given["radius"])
    ratio, young = float(given["ratio"]), given["young"]
    stiff = STIFF * float(young.min()) * float(given["edge"])  # [N/m]
    mu = young / 2.0 / (1.0 + ratio)
    lam = 2.0 * mu * ratio / (1.0 - 2.0 * ratio)
    high = points[:, 2].max()
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_soft_mesh(pos=wp.vec3(0.0), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(0.0),
                          vertices=[wp.vec3(*p) for p in points], indices=tets.ravel().tolist(), density=500.0,
                          k_mu=mu, k_lambda=lam, k_damp=0.0, particle_radius=SHELL, add_surface_mesh_edges=False)
    held = np.flatnonzero(points[:, 2] < 1e-9)
    for k in held:
        builder.particle_mass[k] = 0.0
        builder.particle_flags[k] = builder.particle_flags[k] & ~newton.ParticleFlags.ACTIVE
    looks = newton.ModelBuilder.ShapeConfig()
    looks.ke, looks.kd, looks.mu, looks.margin = stiff, 0.0, 0.0, 0.0
    builder.add_shape_sphere(-1, radius=radius, cfg=looks)
    builder.color()
    with wp.ScopedDevice("cpu"):
        model = builder.finalize()
        model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = stiff, 0.0, 0.0
        pipeline = newton.CollisionPipeline(model, soft_contact_gap=NEAR)
        contacts = pipeline.contacts()
        solver = newton.solvers.SolverVBD(model, iterations=SWEEPS, particle_enable_self_contact=False)
        now, then, control = model.state(), model.state(), model.control()

    def press(depth: float) -> tuple[float, float]:
        nonlocal now, then
        centre = np.array([*given["at"], high + radius - depth])
        model.shape_transform.assign(np.array([[*centre, 0.0, 0.0, 0.0, 1.0]], dtype=np.float32))
        force, left = 0.0, 1.0
        for _ in range(MOST // SWEEPS):
            now.particle_qd.zero_()
            pipeline.collide(now, contacts)
            solver.step(now, then, control, contacts, STEP)
            now, then = then, now
            x = now.particle_q.numpy().astype(float)
            away = x - centre
            far = np.linalg.norm(away, axis=1)
            push = stiff * np.maximum(radius + SHELL - far, 0.0)
            force = float(-(push * away[:, 2] / far).sum())
            left = abs(abs(base_force(x, points, tets, mu, lam, held)) - force) / max(force, 1e-9)
            if left < SETTLED:
                break
        return force, left

    press(-2.0 * NEAR)  # kernels
    settings = (f"vertex block descent, sweeps until {100 * SETTLED:g} % of the force is unbalanced, {MOST} at most; "
                f"linear tetrahedra, stable neo-Hookean; contact of nodes, {STIFF:g} times as stiff as the modulus "
                f"times an edge")
    return newton.__version__, settings, press
