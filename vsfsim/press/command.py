"""What `vsfsim press` does: one press or several meshes of it, then the pictures and files that were asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.press import probe as presses
from vsfsim.press.text import text as table


def press(loaded: SceneFile, *, seed: int, tier: str | None, device: str, precision: str, refine: int | None,
          plot: Path | None, picture: Path | None,
          save: Path | None, progress: Callable[[int, int, str], None]) -> tuple[str, dict[str, Any], bool]:
    """Run it, write the files; returns the text to print, the object for JSON, and whether every frame converged.

    Args:
        loaded: the scene. seed, tier, device, precision: as `press.press`. refine: number of meshes, or None for one.
        plot, picture, save: files to write, or None. progress: called with (done, in all, what).

    Raises:
        VsfsimError: the scene cannot be built, or a file cannot be written.
    """
    keep = picture is not None or save is not None
    scene = loaded.sample(seed)
    if scene.sensor is not None:
        return _press_bubble(scene, loaded.name, tier=tier, seed=seed, device=device, precision=precision,
                             refine=refine, plot=plot, picture=picture, save=save, progress=progress)
    if scene.arm is not None:
        if refine is not None:
            raise SceneError(f"--refine {refine}: a plant has the segments that its family gave it, and no finer mesh; "
                             f"leave --refine out, or make segment in [object.shape] smaller.")
        return _press_plant(loaded, tier=tier, seed=seed, device=device, precision=precision, plot=plot,
                            picture=picture, save=save, progress=progress)
    words, found = [], {}
    if refine is None:
        result = presses.press(scene, tier=tier, device=device, precision=precision, seed=seed, keep=keep,
                               progress=progress)
        good = bool(result.converged.all())
    else:
        from vsfsim.press import refine as refinement

        results, convergence = refinement.refine(scene, refine, tier=tier, device=device, precision=precision,
                                                 seed=seed, cache=None, keep=keep, progress=progress)
        result = results[-1]
        good = all(bool(r.converged.all()) for r in results)
        words = ["", f"Force at full depth on {refine} meshes:", refinement.text(results, convergence)]
        found = {"refinement": {**convergence.table(), "meshes": [r.table() for r in results]}}
        words += [f"note: {note}" for note in results[0].notes if note not in result.notes]
    if plot is not None:
        from vsfsim.press.plot import plot as draw

        draw(result, loaded.name, plot)
    if picture is not None:
        from vsfsim.press.picture import picture as paint

        paint(result, loaded.name, picture, device=device)
        words.append(f"picture: {picture}")
    if save is not None:
        from vsfsim.press.file import save as write

        write(result, save)
        words.append(f"saved: {save}")
    return "\n".join([table(result), *words]), {**result.table(), **found}, good


def _press_bubble(scene: Scene, name: str, *, tier: str | None, seed: int, device: str, precision: str,
                  refine: int | None, plot: Path | None, picture: Path | None,
                  save: Path | None, progress: Callable[[int, int, str], None]) -> tuple[str, dict[str, Any], bool]:
    from vsfsim.press import bubble as press_bubble
    from vsfsim.press import file_bubble as press_bubble_file
    from vsfsim.press import plot as press_plot

    words, found = [], {}
    if refine is None:
        result = press_bubble.press(scene, tier=tier, seed=seed, device=device, precision=precision,
                                    keep=picture is not None or save is not None, progress=progress)
        good = bool(result.converged.all())
    else:
        from vsfsim.press import refine_bubble as refinement

        results, force, pressure = refinement.refine(scene, refine, device=device, precision=precision, cache=None,
                                                     progress=progress)
        result, good = results[-1], all(bool(r.converged.all()) for r in results)
        rows = refinement.rows_of(results, press_bubble.way_in(scene))
        words = ["", f"The press on {refine} meshes, at half and at full depth:",
                 refinement.text(rows, force, pressure)]
        found = {"refinement": {"meshes": rows, "force": force.table(), "pressure_change": pressure.table()}}
    if plot is not None:
        press_plot.plot_pressure(result, name, plot)
        words.append(f"plot: {plot}")
    if picture is not None:
        from vsfsim.press.picture_bubble import picture as paint

        paint(result, scene, name, picture, device=device)
        words.append(f"picture: {picture}")
    if save is not None:
        press_bubble_file.save(result, save)
        words.append(f"saved: {save}")
    return "\n".join([press_bubble.text(result), *words]), {**result.table(), **found}, good


def _press_plant(loaded: SceneFile, *, tier: str | None, seed: int, device: str, precision: str, plot: Path | None,
                 picture: Path | None, save: Path | None,
                 progress: Callable[[int, int, str], None]) -> tuple[str, dict[str, Any], bool]:
    from vsfsim.press import arm as press_plant

    result = press_plant.press(loaded, tier=tier, seed=seed, device=device, precision=precision,
                               keep=picture is not None or save is not None, progress=progress)
    words = []
    if plot is not None:
        press_plant.plot(result, loaded.name, plot)
        words.append(f"plot: {plot}")
    if picture is not None:
        press_plant.picture(result, loaded.name, picture, device=device)
        words.append(f"picture: {picture}")
    if save is not None:
        press_plant.save(result, save)
        words.append(f"saved: {save}")
    return "\n".join([press_plant.text(result), *words]), result.table(), bool(result.converged.all())
