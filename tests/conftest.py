"""What tests share: the device they run on, the command line in this process, and blocks ready for the solver; and how
many processes they take."""

import os
import subprocess
import sys

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy and torch: the processes share the cores already

import numpy as np
import pytest

from vsfsim.core.solid import Solid

WORKERS = 4  # processes at most: each holds a gigabyte
KERNELS = """
from vsfsim.core import scene, shelf
from vsfsim.generate.effector import kernels_of
from vsfsim.physics.runtime import compile_kernels
names = "plants-v5-mini", "shoes-v3-mini", "shoes-v2-punyo-mini"; print("compiling kernels", flush=True)
compile_kernels([k for n in names for k in kernels_of(scene.load_scene(shelf.find_scene(n)).sample(0))], "cpu")
"""


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="Warp device of the physics tests: cpu or cuda:0.")
    parser.addoption("--seeds", type=int, default=1, help="Seeds of the tests that search at random (`trial_seed`): "
                                                          "how their margins are measured, with -s for the figures.")


def pytest_generate_tests(metafunc):
    if "trial_seed" in metafunc.fixturenames:
        metafunc.parametrize("trial_seed", range(metafunc.config.getoption("--seeds")), scope="module")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config):
    """The whole suite on a CPU runs in a process a core and one more, since tests wait a tenth of the time; a file of
    tests in one of them (pytest-xdist); parts of it, and ``-n 0``, in this one."""
    if "PYTEST_XDIST_WORKER" in os.environ or hasattr(config, "workerinput"):
        return  # a worker, and what it starts, makes no workers
    options = config.option
    whole = config.args_source == config.ArgsSource.TESTPATHS and not options.collectonly and not options.usepdb
    if (whole and options.device == "cpu" and config.pluginmanager.hasplugin("xdist")
            and options.numprocesses is None and options.dist == "no"):
        cores = len(os.sched_getaffinity(0))
        if cores > 1:
            options.numprocesses = min(cores + 1, WORKERS)
            options.dist = "loadfile"
            subprocess.run([sys.executable, "-c", KERNELS])  # once, not in every process


@pytest.fixture
def vsfsim(capfd, monkeypatch):
    """Runs `vsfsim WORDS` in folder ``cwd``, in this process: what a process of its own would have given, without its
    start of three seconds.

    That the command works as one, too, is what `test_cli.py` and each of the longer runs hold.
    """
    from vsfsim.cli.main import main

    def run(*words, cwd):
        with monkeypatch.context() as patch:
            patch.chdir(cwd)
            patch.setattr(sys, "argv", ["vsfsim", *map(str, words)])
            capfd.readouterr()
            code = 0
            try:
                main()
            except SystemExit as end:
                code = end.code or 0
            out, err = capfd.readouterr()
        return subprocess.CompletedProcess(words, code, out, err)

    return run


@pytest.fixture(scope="session")
def make_here():
    """Has views made in this process, one after the other: a new one imports the libraries for seconds."""
    from vsfsim.generate.workers import make_one

    def make_each(jobs, *, device, **_):
        return (make_one(job, device) or job.name for job in jobs)

    return lambda patch: [patch.setattr(f"vsfsim.generate.{module}.make_each", make_each)
                          for module in ("on_solids", "effectors.arm")]


@pytest.fixture
def here(make_here, monkeypatch):
    make_here(monkeypatch)


@pytest.fixture(scope="session")
def device(request):
    return request.config.getoption("--device")


@pytest.fixture(scope="session")
def block():
    """Makes a model of a box: block(size, resolution, young_modulus=..., ...).

    young_modulus: [Pa], or a function of the Gauss points (m, 4, 3) [m]. ticks: grid lines along x, y, z [m] instead of
    an even mesh.
    Further keywords go to `build_model`.
    """
    from frame_checks import ticked

    from vsfsim.physics.mesh.quadratic import gauss_points
    from vsfsim.physics.mesh.structured import box
    from vsfsim.physics.model import build_model

    def make(size, resolution, *, young_modulus=1e5, poisson_ratio=0.45, fixed="bottom", ticks=None, **more):
        vertices, tets = box(size, resolution) if ticks is None else ticked(ticks)
        solid = Solid(vertices, tets, np.zeros(len(tets), int), ("body",))
        at = gauss_points(solid)
        values = young_modulus(at) if callable(young_modulus) else np.full(at.shape[:2], float(young_modulus))
        return build_model(solid, values, poisson_ratio=poisson_ratio, fixed=fixed,
                           bottom_tolerance=1e-6 * size[2], where="test", **more)

    return make


@pytest.fixture(scope="session")
def line():
    """Makes poses (T, 1, 4, 4) of a probe at given positions (T, 3) [m], turned towards ``axis``: line(positions,
    probe, axis)."""
    from vsfsim.robot.path import turn_to

    def make(positions, probe, axis=(0.0, 0.0, -1.0)):
        positions = np.asarray(positions, float)
        poses = np.tile(np.eye(4), (len(positions), 1, 1, 1))
        poses[:, 0, :3, :3] = turn_to(np.asarray(axis, float), probe)
        poses[:, 0, :3, 3] = positions
        return poses

    return make


@pytest.fixture(scope="session")
def graded():
    """Makes ticks [m] from 0 to ``length`` that grow geometrically: graded(first, equal, growth, length), ``equal``
    steps of ``first`` [m] to begin with."""

    def make(first, equal, growth, length):
        steps = [first] * equal
        while sum(steps) < length:
            steps.append(steps[-1] * growth)
        return np.concatenate([[0.0], np.cumsum(steps)]) * length / sum(steps)

    return make
