"""The commands of `vsfsim measure`: their options, and the script of this folder that each of them calls."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from vsfsim.cli.console import report, step
from vsfsim.cli.options import DatasetFolder, Device, JsonFile, Parameters, check_choice, parameters_of, picture_option
from vsfsim.core.errors import VsfsimError

app = typer.Typer(rich_markup_mode=None)


def _report(measurement: Any, out: Path | None) -> None:
    """Write a `measurements.measurement.Measurement`."""
    report(measurement.text(), measurement.record(), out, indent=1)


@app.command()
def solver(device: Device = "cpu",
           tier: Annotated[list[str] | None, typer.Option(help="Only this tier; may be given again.")] = None,
           touches: Annotated[int | None, typer.Option(min=1,
                                                       help="Touches of a batch; default: 4 on a CPU, 256 (linear: "
                                                            "4096) on a GPU.")] = None,
           compare: Annotated[bool,
                              typer.Option(help="On a GPU: run a few touches on the CPU as well and compare "
                                                "the forces.")] = True,
           without: Annotated[list[str] | None,
                              typer.Option(help="Press the gate's cells with and without this mechanism; given again: "
                                                "without all of them.")] = None,
           against: Annotated[Path | None,
                              typer.Option(metavar="FILE", help="Compare the gate's cells with a record of --cell "
                                                                "all --json FILE.")] = None,
           cell: Annotated[list[str] | None,
                           typer.Option(help="Press this cell of the gate alone, small for eight quick ones, or all "
                                             "for 40; may be given again.")] = None,
           out: JsonFile = None) -> None:
    """Force error, iterations, back-solve and assembly times of every tier, and touches a second of a batch;
    or what every mechanism of the solver buys on 40 fixed presses."""
    if without or cell or against is not None:
        from measurements.gate.compare import measure as measure_gate

        _report(measure_gate(cell or ("all",), names=without or (), against=against, progress=step), out)
        return
    from measurements.solver import TIERS, measure

    for name in tier or []:
        check_choice("--tier", name, TIERS)
    _report(measure(device=device, tier=tuple(tier) if tier else None, touches=touches, compare=compare, progress=step),
            out)


@app.command()
def laws(out: JsonFile = None) -> None:
    """How far laws of elasticity of the same E and nu differ in uniaxial compression, by their closed forms."""
    from measurements.laws import measure

    _report(measure(progress=step), out)


@app.command()
def shallow(balls: Annotated[int, typer.Option(min=0, help="Also press so many random balls, 24 in pages.")] = 0,
            out: JsonFile = None) -> None:
    """Error of the force against depth, at six places within an element, on meshes of three sizes."""
    from measurements.shallow import measure

    _report(measure(balls=balls, progress=step), out)


@app.command()
def drag(young: Annotated[float, typer.Option(min=100.0, help="Modulus of the block [Pa].")] = 3e4,
         depth: Annotated[float, typer.Option(min=0.001, max=0.02, help="Depth of the press [m].")] = 0.006,
         frames: Annotated[int, typer.Option(min=1, help="Of each move.")] = 10,
         limit: Annotated[float | None, typer.Option(min=0.1, help="Limit of a frame's processor time [s].")] = None,
         out: JsonFile = None) -> None:
    """A bubble dragged by 10 mm and twisted by 45 degrees on a soft block, against Coulomb's law."""
    from measurements.drag import measure

    _report(measure(young=young, depth=depth, frames=frames, limit=limit, progress=step), out)


@app.command()
def methods(paper: Annotated[bool,
                             typer.Option("--paper",
                                          help="The paper's size: 20,000 particles, 60 touches, 900 frames.")] = False,
            particles: Annotated[int | None, typer.Option(min=1,
                                                          help="Particles of the model, about; default 2,000.")] = None,
            touches: Annotated[int | None, typer.Option(min=1,
                                                        help="Touches of a dome of 217 vertices; default 100.")] = None,
            frames: Annotated[int | None, typer.Option(min=2, help="Frames of a touch; default 20.")] = None,
            literal: Annotated[bool,
                               typer.Option(help="Also run each estimator's literal dense form; it takes most "
                                                 "of the time.")] = True,
            fields: Annotated[bool | None,
                              typer.Option(help="Also fit the point VSF, the neural VSF and its fast variant to a "
                                                "buried rope; default: on a GPU.")] = None,
            iterations: Annotated[int | None, typer.Option(min=1,
                                                           help="Of the neural VSF; default: 2,000 on a GPU (1,000 to "
                                                                "3,000 in the paper), 400 on a CPU.")] = None,
            rate: Annotated[float | None, typer.Option(min=1e-6, max=1.0,
                                                       help="Of the neural VSF's training; default: 2e-4, "
                                                            "the paper's.")] = None,
            octaves: Annotated[int, typer.Option(min=1, max=12,
                                                 help="Of the neural VSF's encoding, with --fields.")] = 6,
            export: Annotated[Path | None, typer.Option(metavar="FOLDER",
                                                        help="Also write the workload here: observation matrices, "
                                                             "readings, noise and prior, for estimators "
                                                             "from elsewhere.")] = None,
            openvsf: Annotated[Path | None, typer.Option(metavar="FOLDER",
                                                         help="Run on presses of an arm's Punyo instead, and write "
                                                              "them here as the openvsf package loads them; a "
                                                              "new folder.")] = None,
            urdf: Annotated[Path | None, typer.Option(metavar="FILE",
                                                      help="With --openvsf: openvsf's kinova_gen3.urdf, which is not "
                                                           "ours to ship.")] = None,
            blind: Annotated[bool,
                             typer.Option("--blind",
                                          help="Only this: pose of a known object in a soft block, by "
                                               "every method.")] = False,
            sbml: Annotated[bool,
                            typer.Option("--sbml",
                                         help="Only this: SBML's training on objects of 10,000 readings and 20,000 "
                                              "particles (or the sizes given).")] = False,
            device: Annotated[str, typer.Option(help="Torch device: cpu or cuda:0.")] = "cpu",
            out: JsonFile = None) -> None:
    """Time and memory of every estimator beside its literal dense form, at equal answers; and of the fields, with F1
    and size on disk."""
    from measurements import blind as blind_localisation
    from measurements import estimators
    from measurements import fields as buried_rope
    from measurements import sbml as training
    from measurements.workload import Workload

    buried_rope.check_device(device)
    if urdf is not None and openvsf is None:
        raise VsfsimError(f"--urdf is {urdf}, but nothing is exported for openvsf; add --openvsf FOLDER.")
    if openvsf is not None and (blind or sbml):
        raise VsfsimError("--openvsf exports the workload of the estimators; leave out --blind and --sbml.")

    sizes = training.PAPER if sbml else estimators.PAPER if paper else estimators.MINI
    size = [one or default for one, default in zip((particles, touches, frames), sizes)]
    learning = {"device": device, "iterations": iterations, **({} if rate is None else {"rate": rate})}
    if sbml:
        _report(training.measure(*size, device=device, progress=step), out)
        return
    if blind:
        _report(blind_localisation.measure(**learning, progress=step), out)
        return
    notes: list[str] = []
    if openvsf is None:
        load = Workload.of(*size)
    else:
        from measurements.openvsf import export as export_openvsf

        load, notes = export_openvsf(openvsf, *size, urdf=urdf, progress=step)
        notes.insert(0, f"{load.touches} sequences for openvsf are in {openvsf}.")
    if export is not None:
        load.export(export)
    found = estimators.measure(load, literal=literal, device=device, progress=step)
    if fields if fields is not None else device != "cpu":
        more = buried_rope.measure(**learning, octaves=octaves, progress=step)
        found = replace(found, tables=[*found.tables, *more.tables])
    _report(replace(found, notes=[*notes, *found.notes]), out)


@app.command()
def features(task: Annotated[str,
                             typer.Option(help="Task whose training objects are used; its test objects are not opened, "
                                               "but with --on-test.")] = "inclusion-mini-v3",
             dataset: DatasetFolder = None,
             feature: Annotated[list[str] | None,
                                typer.Option(help="A kind of features; may be given again. Default: local, "
                                                  "local-full, xyzrgb.")] = None,
             noise: Annotated[list[float] | None,
                              typer.Option(help="A noise_std of SBML; may be given again. Default: 1, 3, 10.")] = None,
             folds: Annotated[int, typer.Option(min=2, help="Of the training objects.")] = 4,
             seeds: Annotated[int, typer.Option(min=1, help="Trainings of each variant and fold.")] = 1,
             settings: Parameters = None,
             on_test: Annotated[bool, typer.Option("--on-test",
                                                   help="Learn on all training objects and predict the test objects: "
                                                        "once, after everything was chosen.")] = False,
             out: JsonFile = None) -> None:
    """Choose SBML's features and noise on training objects alone: error of every pair on objects left out."""
    from measurements.choices.features import measure
    from vsfsim.bench.task import load_task, open_dataset
    from vsfsim.data.dataset import Dataset

    wanted = load_task(task)
    data = open_dataset(wanted) if dataset is None else Dataset.open(dataset)
    _report(measure(wanted, data, features=tuple(feature or ("local", "local-full", "xyzrgb")),
                    noises=tuple(noise or (1.0, 3.0, 10.0)), folds=folds, seeds=seeds, settings=parameters_of(settings),
                    on_test=on_test, progress=step), out)


@app.command("field-settings")
def field_settings(dataset: Annotated[Path, typer.Option(help="Objects that the task does not ask: of its scene, with "
                                                              "another seed.")],
                   task: Annotated[str, typer.Option(help="Of a bubble's pressure.")] = "fewshot-shoes-v2-punyo-v1",
                   variant: Annotated[list[str] | None,
                                      typer.Option(help="Only these settings; may be given again.")] = None,
                   trainings: Annotated[int, typer.Option(min=1, help="Of each field.")] = 2,
                   device: Annotated[str, typer.Option(help="Torch device of the network.")] = "cpu",
                   out: JsonFile = None) -> None:
    """Choose settings of the neural and grid fields on other objects: error after five touches and after all."""
    from measurements.choices.field_settings import VARIANTS, measure
    from vsfsim.bench.task import load_task
    from vsfsim.data.dataset import Dataset

    for name in variant or []:
        check_choice("--variant", name, VARIANTS)
    _report(measure(load_task(task), Dataset.open(dataset), variants=tuple(variant or VARIANTS), trainings=trainings,
                    device=device, progress=step), out)


@app.command("pressure-law")
def pressure_law(dataset: Annotated[Path | None,
                                    typer.Argument(help="Folder of a dataset made with a bubble; without one, eight "
                                                        "presses on a rigid ball.")] = None,
                 plot: Annotated[Path | None, picture_option("Also draw it here.")] = None,
                 nodes: Annotated[int, typer.Option(min=100, help="Nodes of the membrane, without a dataset.")] = 390,
                 area: Annotated[float | None, typer.Option(min=1e-6,
                                                            help="A_base of openvsf's law [m^2]: 7.1827e-3 for its "
                                                                 "mesh of the bubble alone, 6.6019e-3 for its mesh on "
                                                                 "the arm; default: the area inside the rim of the "
                                                                 "dataset's bubble, 7.1827e-3 without one.")] = None,
                 out: JsonFile = None) -> None:
    """Bias and scatter of the pressure laws in use (SBML eq. 8, openvsf) against the gas of a sealed bubble."""
    from measurements.pressure_law import measure
    from vsfsim.data.dataset import Dataset

    data = None if dataset is None else Dataset.open(dataset, blind=True)
    _report(measure(data, nodes=nodes, area=area, plot=plot, progress=step), out)


@app.command("dense-force")
def dense_force(dataset: Annotated[Path | None,
                                   typer.Argument(help="Folder of a dataset made with a bubble; without one, presses "
                                                       "on rigid balls.")] = None,
                nodes: Annotated[int | None, typer.Option(min=100,
                                                          help="Nodes of the simulated membrane; default: the "
                                                               "sensor's 1493.")] = None,
                device: Device = "cpu",
                out: JsonFile = None) -> None:
    """Estimated contact forces of the bubble against the simulator's true ones, over depth and noise."""
    if dataset is None:
        from measurements.dense_force import measure

        _report(measure(nodes=nodes, device=device, progress=step), out)
        return
    if nodes is not None:
        raise VsfsimError(f"--nodes is {nodes}, but the touches are those of {dataset}; leave one of them out.")
    from measurements.dense_force.dataset import measure as measure_dataset
    from vsfsim.data.dataset import Dataset

    _report(measure_dataset(Dataset.open(dataset, blind=True), progress=step), out)


@app.command()
def plants(device: Device = "cpu",
           scene: Annotated[str,
                            typer.Option(help="Name of a scene with [arm], or the path of its .toml file.")] = "plants",
           objects: Annotated[int | None, typer.Option(min=1,
                                                       help="Plants; default: 3 on a CPU, the scene's own "
                                                            "number on a GPU.")] = None,
           views: Annotated[int | None,
                            typer.Option(min=1,
                                         help="Views of each; default: 1 on a CPU, the scene's own "
                                              "number on a GPU.")] = None,
           touches: Annotated[int | None, typer.Option(min=1,
                                                       help="Touches of each view; default: 6 on a CPU, the scene's "
                                                            "own number on a GPU.")] = None,
           seconds: Annotated[float | None, typer.Option(min=1.0,
                                                         help="End about this long after the kernels are ready; what "
                                                              "was done by then is counted.")] = None,
           workers: Annotated[int | None, typer.Option(min=1,
                                                       help="Processes that prepare and finish views; default: 1 on a "
                                                            "CPU, one a core on a GPU.")] = None,
           out: JsonFile = None) -> None:
    """Touches and readings a second of plants under an arm, split by stage."""
    from measurements.plants import measure

    _report(measure(device=device, scene=scene, objects=objects, views=views, touches=touches, seconds=seconds,
                    workers=workers, progress=step), out)


@app.command()
def touches(dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of a dataset made with an arm.")],
            out: JsonFile = None) -> None:
    """Torques, forces and stiffness of the touches of a plants dataset, beside those of a real plant."""
    from measurements.artificial_plants.figures import measure

    _report(measure(dataset, progress=step), out)


@app.command(name="shoe-forces")
def shoe_forces(dataset: Annotated[Path | None, typer.Argument(metavar="DATASET",
                                                               help="Folder of a dataset of named shoes; default: "
                                                                    "datasets/shoes-v2-mini-v3.")] = None,
                out: JsonFile = None) -> None:
    """How hard the parts of shoes push back at 5 and 10 mm of travel, by material."""
    from measurements.shoe_forces import measure

    _report(measure(dataset, progress=step), out)


@app.command(name="plant-prior")
def plant_prior(task: Annotated[str, typer.Argument(metavar="TASK", help="Name of a task, or the path of its .toml "
                                                                         "file.")],
                dataset: DatasetFolder = None, out: JsonFile = None) -> None:
    """How much of the stiffness a picture tells: priors learned from readings, with and without each feature."""
    from measurements.artificial_plants.prior import measure

    _report(measure(task, folder=dataset, progress=step), out)


@app.command(name="plant-learning")
def plant_learning(task: Annotated[str, typer.Argument(metavar="TASK", help="Name of a task with joint torques, or the "
                                                                            "path of its .toml file.")],
                   dataset: DatasetFolder = None,
                   workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1, out: JsonFile = None) -> None:
    """What limits a field of springs on plants: touches, noise, where springs start, or what they can represent."""
    from measurements.artificial_plants.learning import measure

    _report(measure(task, folder=dataset, workers=workers, progress=step), out)


@app.command(name="plant-sheet")
def plant_sheet(scene: Annotated[str, typer.Argument(help="Name of a scene with [arm], or the path of its .toml "
                                                          "file.")] = "plants-v4",
                picture: Annotated[Path | None, picture_option("Also draw them here, with their names.")] = None,
                objects: Annotated[int | None, typer.Option(min=1,
                                                            help="Plants; default: the scene's own number.")] = None,
                seed: Annotated[int, typer.Option(min=0, help="Of the dataset.")] = 0, out: JsonFile = None) -> None:
    """Sizes of the plants of a scene, and a sheet of their pictures."""
    from measurements.artificial_plants.sheet import measure

    _report(measure(scene, picture=picture, objects=objects, seed=seed, progress=step), out)


@app.command(name="plant-likeness")
def plant_likeness(scene: Annotated[str, typer.Option(help="Scene of plants, with [arm].")] = "plants-v4-mini",
                   objects: Annotated[int | None, typer.Option(min=1, help="Plants; default: the scene's.")] = None,
                   touches: Annotated[int, typer.Option(min=1, help="Touches of each plant.")] = 5,
                   seed: Annotated[int, typer.Option(min=0, help="Of the dataset.")] = 1, out: JsonFile = None) -> None:
    """How alike touches are that pass some millimetres beside each other."""
    from measurements.artificial_plants.likeness import measure

    _report(measure(scene=scene, objects=objects, touches=touches, seed=seed, progress=step), out)


@app.command(name="plant-yield")
def plant_yield(scene: Annotated[str, typer.Option(help="Scene of artificial plants.")] = "plants-v4-mini",
                objects: Annotated[int | None, typer.Option(min=1, help="Plants; default: the scene's.")] = None,
                touches: Annotated[int, typer.Option(min=1, help="Touches of each plant.")] = 6,
                out: JsonFile = None) -> None:
    """What yielding wires change in the touches of artificial plants."""
    from measurements.artificial_plants.wires import measure

    _report(measure(scene=scene, objects=objects, touches=touches, progress=step), out)


@app.command()
def bubble(device: Device = "cpu",
           touches: Annotated[int | None, typer.Option(min=1,
                                                       help="Touches of the batch; default: 4 on a CPU, "
                                                            "800 on a GPU.")] = None,
           frames: Annotated[int, typer.Option(min=4, help="Of a touch.")] = 15,
           tier: Annotated[str, typer.Option(help="Of the shoe: fem-coarse, fem or fem-fine.")] = "fem",
           resolution: Annotated[float, typer.Option(min=0.005, max=0.1,
                                                     help="Size of its cells [m]; 0.0095 makes 5,256 "
                                                          "tetrahedra.")] = 0.0095,
           nodes: Annotated[int | None, typer.Option(min=100, max=3000,
                                                     help="Of the bubble; default: the scene's 390.")] = None,
           compare: Annotated[int,
                              typer.Option(min=0,
                                           help="On a GPU: run so many of the touches on the CPU as well and compare "
                                                "the forces.")] = 0,
           out: JsonFile = None) -> None:
    """Seconds a frame and touches a minute of a bubble pressed on a soft shoe."""
    from measurements.bubble import measure

    check_choice("--tier", tier, ("fem-coarse", "fem", "fem-fine"))
    _report(measure(device=device, touches=touches, frames=frames, tier=tier, resolution=resolution, nodes=nodes,
                    compare=compare, progress=step), out)


@app.command()
def arm(device: Annotated[str, typer.Option(help="Warp device of the plant: cpu or cuda:0.")] = "cpu",
        scene: Annotated[str, typer.Option(help="Name of a scene with [arm], or the path of its "
                                                ".toml file.")] = "plants-mini",
        touches: Annotated[int, typer.Option(min=1, help="Touches of one plant.")] = 6,
        out: JsonFile = None) -> None:
    """The two arm modes side by side: joint torques of a moving arm less J^T f, part by part, and the time of both."""
    from measurements.arm import measure

    _report(measure(device=device, scene=scene, touches=touches, progress=step), out)
