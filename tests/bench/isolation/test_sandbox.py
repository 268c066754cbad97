"""What a method cannot reach or leave behind: nothing passes from one training or trial to another, to the scorer or to
the user; every way is tried."""

import dataclasses
import fcntl
import hashlib
import os
import py_compile
import subprocess
import sys
import time
from pathlib import Path
from py_compile import PycInvalidationMode

import hostile_leaks
import pytest
import toy_methods

import vsfsim
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.isolation import limits
from vsfsim.bench.isolation.limits import SANDBOXES, Isolation
from vsfsim.bench.isolation.process import MethodHost
from vsfsim.core.errors import MethodError

BOXES = [name for name in SANDBOXES if limits.works(name)]
CONTAINERS = [name for name in BOXES if name != "process"]
container = pytest.mark.skipif(not CONTAINERS, reason="no namespaces here")


def gone(pid):
    until = time.monotonic() + 10.0
    while time.monotonic() < until:
        try:
            if open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[0] in "ZX":
                return True
        except OSError:
            return True
        time.sleep(0.02)
    return False


@pytest.mark.parametrize("box", BOXES)
def test_a_method_scores_the_same_in_every_sandbox_and_the_row_says_which(task, toy_dataset, honest, box):
    found = evaluate("toy_methods:Constant", task, toy_dataset, seeds=1, sandbox=box)
    assert found.scores == honest and found.isolation == box


def test_what_has_left_its_session_ends_with_the_trial(one_trial, tmp_path):
    with one_trial("hostile_methods:LeavesSession", Isolation("process")) as make:
        make("5", REPORT=str(tmp_path / "pid"))
        assert gone(int((tmp_path / "pid").read_text()))


@pytest.mark.parametrize("box", CONTAINERS)
def test_a_container_shows_what_a_parameter_names_and_not_the_dataset(one_trial, toy_dataset, tmp_path, box):
    (tmp_path / "weights").write_text("1")
    with one_trial("hostile_methods:NeedsFile", Isolation(box), path=str(tmp_path / "weights")) as make:
        make("0")
    with one_trial("hostile_methods:NeedsFile", Isolation(box), path=str(tmp_path / "weights") + "x") as make, \
            pytest.raises(MethodError, match=r"FileNotFoundError in .*It runs in a container \(--sandbox "):
        make("0")
    with pytest.raises(MethodError, match=r"in which .*/toy lies, which no method may see"), one_trial(
            "hostile_methods:NeedsPart", Isolation(box), folder=str(toy_dataset.path.parent), file="any"):
        pass


def test_the_default_is_the_strongest_that_works(monkeypatch):
    monkeypatch.delenv("VSFSIM_SANDBOX")
    assert Isolation().sandbox == limits.strongest() == BOXES[0]
    monkeypatch.setattr(limits, "works", lambda name: name == "process")
    assert Isolation().sandbox == "process"
    with pytest.raises(MethodError, match=r"--sandbox namespaces does not work here: .* that works: process"):
        Isolation("namespaces")


def test_the_time_limit_holds_in_the_check_too(task, toy_dataset):
    with pytest.raises(MethodError, match=r"check of its contract took longer than 4 s; --timeout is 0.2 s a call"):
        evaluate("hostile_methods:Sleeps", task, toy_dataset, seeds=1, timeout=0.2, sandbox="process")


@pytest.mark.parametrize(("name", "entry"), [("contact-points", "vsfsim.baselines.contact_points:ContactPoints"),
                                             ("own:Own", "own:Own")])
@pytest.mark.parametrize("box", CONTAINERS)
def test_a_container_shows_packages_that_no_folder_of_the_path_holds(box, name, entry, tmp_path, monkeypatch):
    """An "editable" installation is found by an import hook, and a user works somewhere else."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text("class Own:\n    def meta_fit(self, specimens): ...\n"
                                     "    def adapt(self, view, support): ...\n    def predict(self, touches): ...\n")
    code = ("from vsfsim.bench.isolation.process import MethodHost\n"
            "from vsfsim.bench.isolation.limits import Isolation\n"
            f"from pathlib import Path\nwith MethodHost({name!r}, {{}}, Isolation({box!r}), "
            f"Path('log')) as one:\n    print(one.look(check=False).entry)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.strip() == entry, done.stderr


@pytest.mark.parametrize(("folder", "is_searched"), [(Path(vsfsim.__path__[0]).parent, True), (Path("/usr"), False)])
def test_of_the_working_folder_the_package_alone_is_imported(monkeypatch, tmp_path, folder, is_searched):
    """As with PYTHONPATH=. where packages were unpacked; other modules there are the user's."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    with MethodHost("toy_methods:Constant", {}, Isolation("process"), tmp_path / "log") as host:
        assert (str(folder) in host._search) == is_searched
    assert not host._folder.exists(), "nothing is left of it"


@pytest.fixture
def leaks(task, toy_dataset, tmp_path):
    """Evaluates `Leaks` in two trainings; returns its scores, the ways by which a note was found, and what it
    printed."""
    def run(box, ways, seeds=2):
        brief = dataclasses.replace(task, protocol=dataclasses.replace(task.protocol, shots=(0,)))
        found = evaluate("hostile_leaks:Leaks", brief, toy_dataset, seeds=seeds, check=False,
                         out=tmp_path / "r.json", parameters={"ways": ",".join(ways)}, sandbox=box)
        text = (tmp_path / "r.json.log").read_text()
        notes = {line.removeprefix("found ") for line in text.splitlines() if line.startswith("found")}
        return found.scores, notes, text

    return run


def content(folder):
    """What lies in a folder, without bytecode, which this process writes itself."""
    out = hashlib.sha256()
    for path in sorted(Path(folder).rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            out.update(str(path).encode() + path.read_bytes())
    return out.hexdigest()


KERNEL = b"compiled for the user"


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """A file in the user's folder of compiled kernels."""
    path = tmp_path / "warp" / "1" / "wp_kernel" / "kernel.o"
    path.parent.mkdir(parents=True)
    path.write_bytes(KERNEL)
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "warp"))
    return path


@container
def test_no_note_passes_in_a_container(honest, leaks, kernel):
    outside = [kernel.parent, Path(vsfsim.__file__).parent, Path(hostile_leaks.__file__).parent]
    before = list(map(content, outside))
    scores, found, text = leaks("namespaces", list(hostile_leaks.WAYS))
    assert found == set()
    assert text.count("looked in training") == 2 and text.count("looked in trial") == 8
    assert all(by_shot[shot].per_seed == (honest[metric][shot].mean,) * 2
               for metric, by_shot in scores.items() for shot in by_shot)
    assert list(map(content, outside)) == before, "nothing of the user's is another one"
    for folder in ("/tmp", "/var/tmp", "/dev/shm", os.path.expanduser("~/.config"), "/"):
        assert not os.path.exists(os.path.join(folder, hostile_leaks.NOTE))


def test_the_same_notes_pass_where_there_is_no_container(leaks, kernel):
    """The ways are ways: a plain process shares memory and files with others. Files that change are seen even there."""
    try:
        _, found, _ = leaks("process", ["working folder", "System V memory", "class attribute"], 1)
        assert found == {"System V memory"}, "folder and memory are a process's own there, too"
        leaks("process", ["kernels"], 1)
        assert kernel.read_bytes() == KERNEL, "the user's next command runs what it has compiled itself"
        with pytest.raises(MethodError, match=f"was changed while it was evaluated: /tmp/{hostile_leaks.NOTE} has"):
            leaks("process", ["/tmp"])
    finally:
        Path("/tmp", hostile_leaks.NOTE).unlink(missing_ok=True)
        os.system(f"ipcrm -M {hostile_leaks.KEY} 2>/dev/null")


@container
def test_a_container_shows_the_package_and_the_method_and_nothing_else(one_trial, toy_dataset, tmp_path, monkeypatch):
    """The working folder, though in one of the system's, boards, records, tasks, scenes, the name of the dataset and
    the user's environment are hidden."""
    monkeypatch.setattr(limits, "_SYSTEM", (*limits._SYSTEM, str(tmp_path.parent)))
    (tmp_path / "looks.py").write_text(
        "import os, sys\nfrom toy_methods import Constant\n\n\nclass Looks(Constant):\n"
        "    def adapt(self, view, support):\n        super().adapt(view, support)\n"
        "        import vsfsim\n        root = os.path.dirname(os.path.dirname(vsfsim.__file__))\n"
        "        print('here', sorted(os.listdir(os.path.dirname(__file__))), "
        f"sorted(os.listdir('.')))\n        print('root', sorted(os.listdir(root)))\n"
        "        frame = sys._getframe()\n        while frame := frame.f_back:\n"
        f"            print('frame', {str(toy_dataset.path)!r} in str(frame.f_locals))\n"
        "        print('secret', 'SECRET' in os.environ, [k for k, v in os.environ.items() if 'toy' in v])\n")
    (tmp_path / "answers.csv").write_text("1,2,3\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SECRET", "token")
    with one_trial("looks:Looks", Isolation("namespaces")) as make:
        make("0")
    lines = set(make.log.read_text().splitlines())
    assert "here ['looks.py'] ['.cache']" in lines and "secret False []" in lines
    assert {"frame True", "frame False"} & lines == {"frame False"}
    (root,) = [line for line in lines if line.startswith("root")]
    assert not [name for name in ("leaderboard", "tasks", "scenes", "measurements") if f"'{name}'" in root]


@container
def test_of_a_methods_package_sources_are_run_and_pipes_lead_nowhere(one_trial, tmp_path, monkeypatch):
    """Bytecode is in no digest, and a pipe passes readings between trainings that run at once."""
    package = tmp_path / "packed"
    package.mkdir()
    for text in ("bytecode", "source"):
        (package / "__init__.py").write_text(f"from toy_methods import Constant\n\n\nclass Own(Constant):\n"
                                             f"    def meta_fit(self, specimens):\n        print('{text}', open("
                                             f"__file__[:-11] + 'pipe', 'w+b', 0).read(1))\n")
        if text == "bytecode":
            py_compile.compile(package / "__init__.py", invalidation_mode=PycInvalidationMode.UNCHECKED_HASH)
    os.mkfifo(package / "pipe")
    os.chmod(package / "pipe", 0o666)
    monkeypatch.chdir(tmp_path)
    with open(package / "pipe", "w+b", 0) as pipe, one_trial("packed:Own", Isolation("namespaces")) as make:
        pipe.write(b"1")
        make("0")
    assert make.log.read_text() == "source b''\n"


@container
def test_memory_processes_and_files_are_limited_by_default(one_trial):
    with one_trial("hostile_methods:Greedy", Isolation("namespaces")) as make:
        for code, printed in (("x = bytearray(3 << 40)", "MemoryError"),
                              ("[os.posix_spawn('/bin/sleep', ['sleep', '60'], {}) for _ in range(600 + 32 * "
                               "os.cpu_count())]", "BlockingIOError"),
                              ("[os.mknod(str(k)) for k in range(1 << 17)]", "OSError"),
                              ("os.posix_fallocate(os.open('/tmp/x', os.O_CREAT | os.O_RDWR), 0, 3 << 30)", "OSError")):
            make("0", CODE=code)
            assert make.log.read_text().split()[-1] == printed


@container
def test_trials_that_run_at_once_cannot_signal_by_what_the_kernel_keeps_of_a_file(one_trial):
    """Locks of all kinds, leases and watches of a file that two containers see have no effect, and no error."""
    held = open(toy_methods.__file__, "rb")
    fcntl.flock(held, fcntl.LOCK_EX)
    with one_trial("hostile_methods:Greedy", Isolation("namespaces")) as make:
        for code in ("fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)",
                     "for what in (6, 7, 37, 38): fcntl.fcntl(file, what, bytes(32))",
                     "for what in (1024, 1026): fcntl.fcntl(file, what, 1)",
                     "assert LIBC.inotify_add_watch(LIBC.inotify_init1(0), file.name.encode(), 32) == 0"):
            make("0", CODE="import fcntl; LIBC = ctypes.CDLL(None); file = "
                           f"open(toy_methods.__file__, 'rb')\n{code}\nraise EOFError")
            assert make.log.read_text().split()[-1] == "EOFError"
    locks = Path("/proc/locks").read_text()
    assert locks.count(f":{os.fstat(held.fileno()).st_ino} ") == 1, "the test's own"
