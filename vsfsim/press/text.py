"""A press in words: the table of its frames, and whether it can be trusted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vsfsim.physics.solve.frames import Frames, Reason

if TYPE_CHECKING:
    from vsfsim.press.probe import PressResult

BALANCE = 1e-3  # design: contact force and support reaction agree to 0.1 %
# det F under which small strain is a bad approximation: case S1 at 5 mm has 0.87, and small strain is 3.6 % low there
# (physics.md)
SMALL = 0.85
PENETRATION = 0.01  # of an element: the solver's promise


def statement(frames: Frames, column: int, *, edge: float, tolerance: float, linear: bool) -> str:
    """One paragraph: did every frame converge, how well do the forces balance, how deep is the penetration.

    Args:
        frames: of the solver. column: the touch. edge: mean edge of the mesh [m]. tolerance: of the residual [-].
        linear: the tier is small-strain.
    """
    good = frames.converged[:, column]
    total = len(good)
    if good.all():
        head = f"All {total} frames converged." if total > 1 else "The frame converged."
    else:
        bad = np.flatnonzero(~good)
        why = {}
        for t in bad:
            why.setdefault(Reason(int(frames.reason[t, column])).text or "out of tolerance", []).append(str(t + 1))
        listing = "; ".join(f"{', '.join(at[:10])}{', ..' if len(at) > 10 else ''}: {reason}" for reason,
                            at in why.items())
        head = (f"{len(bad)} of {total} frames did NOT converge ({listing}). Their forces are not those of an "
                f"equilibrium. "
                "Take more frames, a finer mesh (a lower resolution in [object]), or a shallower press.")
    balance = float(frames.force_balance[:, column].max())
    deepest = float(frames.penetration[:, column].max()) + 0.0  # no minus zero
    worst = float(frames.residual[:, column].max())
    det = float(frames.min_det_f[:, column].min())
    words = [head, f"Force on the bodies and reaction of the supports agree to {balance:.1e}"
             + (f", more than the {BALANCE:g} that is allowed;" if balance > BALANCE else ";"),
             f"residual at most {worst:.1e} (tolerance {tolerance:g});",
             f"deepest penetration {1e6 * deepest:.2g} um, {100 * deepest / edge:.2g} % of an element"
             + (", more than the 1 % that is aimed at;" if deepest > PENETRATION * edge else ";"),
             f"smallest det F {det:.3f}" + (": an element is turned inside out." if det <= 0.0 else ".")]
    if linear and det < SMALL:
        words.append(f"That is no longer small strain, which tier linear assumes (det F over {SMALL:g}): its force may "
                     f"be off by ten per cent and more; run it with --tier fem.")
    return " ".join(words)


def text(result: PressResult) -> str:
    """The result as a table for people."""
    rows = ["  depth mm    force N      fx       fy       fz   balance  min det F   energy J  penetr. %  residual  "
            "iterations     s"]
    for t in range(len(result.depth)):
        f = result.force[t]
        mark = "" if result.converged[t] else "  NOT CONVERGED"
        rows.append(f"{1e3 * result.depth[t]:10.3f} {np.linalg.norm(f):10.4f} {f[0]:8.4f} {f[1]:8.4f} {f[2]:8.4f}  "
                    f"{result.audit['force_balance'][t]:8.1e}"
                    f" {result.audit['min_det_f'][t]:10.3f} {result.audit['energy'][t]:10.2e} "
                    f"{100 * result.audit['penetration'][t] / result.edge:10.2g}"
                    f"  {result.residual[t]:8.1e} {result.iterations[t]:11d} {result.seconds[t]:5.2f}{mark}")
    if len(result.bodies) > 1 or max(result.friction) > 0.0:
        t = result.inward - 1
        rows.append("At full depth: "
                    + "; ".join(f"{name}{f' (friction {mu:g})' if mu else ''} "
                                f"({', '.join(f'{v:.4f}' for v in force + 0.0)}) N"
                                                  for name, mu,
                                force in zip(result.bodies, result.friction, result.body_force[t], strict=True))
                    + (f"; {100 * result.slipping[t]:.0f} % of the points in contact slip."
                       if max(result.friction) > 0.0 else "."))
    rows.append(result.statement)
    rows.append(f"Tier {result.tier}, {result.tets} quadratic tetrahedra, {result.nodes} nodes, element size "
                f"{1e3 * result.element_size:.1f} mm, "
                f"{result.precision} on {result.device}; built in {result.build_seconds:.1f} s, solved in "
                f"{result.seconds.sum():.1f} s.")
    rows.extend(f"note: {sentence}" for sentence in result.notes)
    return "\n".join(rows)
