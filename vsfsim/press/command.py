"""What `vsfsim press` does: one press or several meshes of it, then its pictures and files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from vsfsim.core.scene import SceneFile
from vsfsim.generate.effector import effector_of
from vsfsim.generate.press_result import PressRequest
from vsfsim.press import archive, refine
from vsfsim.press.text import text


def press(loaded: SceneFile, *, seed: int = 0, tier: str | None = None, device: str = "cpu", precision: str = "float64",
          meshes: int | None = None, plot: Path | None = None, picture: Path | None = None, save: Path | None = None,
          cache: Path | None = None,
          progress: Callable[[int, int, str], None] | None = None) -> tuple[str, dict[str, Any], bool]:
    """Make the press and write the files.

    Args:
        loaded: the scene.
        seed, tier, device, precision, cache, progress: as of `PressRequest`.
        meshes: number of meshes, or None for one press.
        plot, picture, save: files to write, or None.

    Returns:
        The text to print, the object for JSON, and whether every frame converged.

    Raises:
        VsfsimError: the scene cannot be built, or a file cannot be written.
    """
    request = PressRequest(seed, tier, device, precision, cache, picture is not None or save is not None, progress)
    effector = effector_of(loaded.sample(seed))
    words: list[str] = []
    extrapolated: dict[str, Any] = {}
    if meshes is None:
        results = (effector.press(loaded, request),)
    else:
        series = effector.refine(loaded, request, meshes)
        results = series.results
        found = refine.extrapolate(series, str(loaded.path))
        words, extrapolated = ["", *refine.text(series, found)], {"refinement": refine.table(series, found)}
    result = results[-1]
    if plot is not None or picture is not None:
        from vsfsim.press import figures  # imports matplotlib

        if plot is not None:
            figures.plot(result, loaded.name, plot)
            words.append(f"plot: {plot}")
        if picture is not None:
            figures.picture(result, loaded.name, picture, device=device)
            words.append(f"picture: {picture}")
    if save is not None:
        archive.save(result, save)
        words.append(f"saved: {save}")
    return ("\n".join([text(result), *words]), {**result.table(), **extrapolated},
            all(bool(r.converged.all()) for r in results))
