"""The press in MuJoCo: a flex of the same tetrahedra (linear, St Venant-Kirchhoff), pressed by a sphere that moves.

Runs in a venv of its own with mujoco; nothing of vsfsim is imported. A flex is dynamic: the sphere goes to each depth
at `SPEED` and stands for `REST`, with damping.
The flex has one Young's modulus, so that a body with a part inside cannot be made.
"""

import mujoco
import numpy as np

STEP = 2e-4  # [s]
SPEED = 0.05  # of the sphere [m/s]
REST = 0.05  # [s]
DAMPING = 0.01  # of the elasticity [s]
DENSITY = 500.0  # [kg/m^3]
SHELL = 1e-4  # radius of the flex [m]

XML = """
<mujoco>
  <option timestep="{step}" gravity="0 0 0" integrator="discrete" solver="CG" tolerance="1e-10" iterations="200"/>
  <size memory="1G"/>
  <worldbody>
    <body name="ball" mocap="true" pos="{at[0]} {at[1]} {start}">
      <geom name="ball" type="sphere" size="{radius}" solref="0.002 1" solimp="0.99 0.999 0.0001"/>
    </body>
    <flexcomp name="block" type="direct" dim="3" radius="{shell}" mass="{mass}" point="{points}" element="{tets}">
      <elasticity young="{young}" poisson="{ratio}" damping="{damping}"/>
      <contact selfcollide="none" condim="1" solref="0.002 1" solimp="0.99 0.999 0.0001"/>
      <pin id="{pins}"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


def words(values: np.ndarray) -> str:
    """Numbers for an attribute."""
    return " ".join(f"{v:.9g}" for v in np.asarray(values).ravel())


def make(given):
    """See `measurements.indent.pressing`."""
    points, tets = given["points"], given["tets"]
    if np.ptp(given["young"]) > 1e-6 * given["young"].max():
        return "a flex has one Young's modulus, and the block has a stiff part inside"
    radius, high = float(given["radius"]), points[:, 2].max()
    start = high + radius + SHELL
    model = mujoco.MjModel.from_xml_string(XML.format(
        step=STEP, at=given["at"], start=start, radius=radius, shell=SHELL,
        mass=DENSITY * float(np.prod(np.ptp(points, axis=0))), points=words(points), tets=words(tets),
        young=float(given["young"].max()), ratio=float(given["ratio"]), damping=DAMPING,
        pins=words(np.flatnonzero(points[:, 2] < 1e-9))))
    data = mujoco.MjData(model)

    def press(depth: float) -> tuple[float, float]:
        stop = start - depth
        while data.mocap_pos[0, 2] > stop:
            data.mocap_pos[0, 2] = max(stop, data.mocap_pos[0, 2] - SPEED * STEP)
            mujoco.mj_step(model, data)
        for _ in range(round(REST / STEP)):
            mujoco.mj_step(model, data)
        found, one = 0.0, np.zeros(6)
        for k in range(data.ncon):
            mujoco.mj_contactForce(model, data, k, one)
            found += abs(one[0] * data.contact[k].frame[2])
        # what is left of the motion: mass times acceleration of all nodes over the contact force
        moving = model.body_mass[1:].sum() / max(model.nbody - 2, 1) * np.abs(data.qacc).sum()
        return float(found), float(moving / max(found, 1e-9))

    settings = (f"flex of linear tetrahedra, St Venant-Kirchhoff, steps of {1e3 * STEP:g} ms, {1e3 * REST:g} ms of "
                f"rest a frame, damping {DAMPING:g} s")
    return mujoco.__version__, settings, press
