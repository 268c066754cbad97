"""Whether a dataset that was made for an accuracy keeps it, by its touches that were solved again one level finer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vsfsim.data.records import ObjectView, Touch

ENOUGH = 0.95
"""Share of the audited touches that must be within the accuracy asked for [-]."""


def audit_error(touch: Touch) -> float | None:
    """Error of a touch by its audit [-], None if it was not audited or met nothing; see `error_against`."""
    if "finer_force" not in touch.audit:
        return None
    return error_against(touch.force, touch.converged, np.asarray(touch.audit["finer_force"]),
                         np.asarray(touch.audit["finer_converged"], bool))


def error_against(force: np.ndarray, converged: np.ndarray, finer: np.ndarray, found: np.ndarray) -> float | None:
    """Root mean square over the frames in contact of the difference from the force on the finer mesh, over that mesh's
    largest force [-]; infinite if frames have no equilibrium on the finer mesh alone, None if nothing was met.

    Args:
        force, finer: of a touch and of its audit (T, 3) [N]. converged, found: frames with an equilibrium (T,).
    """
    if (converged & ~found).any():
        return float("inf")
    size = np.linalg.norm(finer, axis=1)
    on = converged & ((size > 0.0) | (np.linalg.norm(np.nan_to_num(force), axis=1) > 0.0))
    if not on.any():
        return None
    return float(np.sqrt(np.mean(np.sum((force - finer)[on] ** 2, axis=1))) / max(size[on].max(), 1e-300))


def audit_errors(view: ObjectView) -> tuple[float, ...]:
    """Errors of the audited touches of a view [-], rounded as dataset.json holds them."""
    found = (audit_error(touch) for touch in view.touches)
    return tuple(float(f"{min(error, 1e3):.4g}") for error in found if error is not None)


def observed(options: Mapping[str, Any], tier: str, errors: Sequence[float]) -> dict[str, Any] | None:
    """What dataset.json says of an accuracy: asked, chosen, expected, observed; None if none was asked for.

    Args:
        options: of the recipe. tier: of the recipe. errors: of all audited touches [-].
    """
    promise = options.get("accuracy")
    if not isinstance(promise, Mapping):
        return None
    all_ = np.asarray(errors, float)
    within = float((all_ <= promise["asked"]).mean()) if len(all_) else 0.0
    sizes = {name: options[name] for name in ("resolution", "contact") if name in options}
    return {"asked": promise["asked"], "chosen": {"tier": tier, **sizes}, "expected": promise["expected"],
            "observed": {"audits": len(all_), "within": within,
                         "rms": float(np.sqrt(np.mean(all_**2))) if len(all_) else None,
                         "worst": float(all_.max()) if len(all_) else None}}


def broken(found: Mapping[str, Any]) -> str | None:
    """Why a promise, as `observed` gives it, is not kept, or None."""
    seen = found["observed"]
    if seen["audits"] and seen["within"] >= ENOUGH:
        return None
    worst = "" if seen["worst"] is None else f"; the worst is off by {100 * seen['worst']:.2g} %"
    return (f"promises an accuracy of {100 * found['asked']:g} %, and {100 * seen['within']:.0f} % of {seen['audits']} "
            f"audited touches keep it, under {100 * ENOUGH:g} %{worst}.")
