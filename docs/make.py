"""Makes every picture and table of README and pages that is older than what it is made from: `python docs/make.py`.

`python docs/make.py NAME ...` makes those; `results` are the tables of the rows that ship, in seconds, and
`NAME=FILE,...` is a table from what another machine wrote with --json. `--check` names what is older, with the CPU
minutes that it takes, and fails. A product is as old as the digest beside its name in `made.json`: of its command, of
the scene, and of the code that the command passes through, without docstrings and comments. Tables of rows need none: a
test writes them again.
"""

import ast
import functools
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).parent
ROOT = FOLDER.parent
sys.path[:0] = [str(ROOT), str(FOLDER)]
MADE = FOLDER / "made.json"
WIDTH = 1000  # px: what a page shows
LAYERS = ("core", "physics", "robot", "sensing", "generate", "press", "view", "vsf")
"""Parts of vsfsim that a picture or a measurement passes through."""
PICTURES = {
    "shoe": [["show", "shoes-v3-mini", "--seed", "3", "--out", "OUT"]],
    "bubble": [["press", "punyo", "--picture", "OUT"]],
    "plant": [["press", "plants-v5-mini", "--seed", "1", "--picture", "OUT"]],
    "hidden": [["generate", "docs/pictures/hidden.toml", "--out", "DATASET"],
               ["show", "DATASET", "--method", "fem-map-seen", "--out", "GIF", *(
                   word for one in ("reach=0.02", "floor=0.02", "share=0.05", "objects=3", "presses=6")
                   for word in ("--set", one))]],
    "contact-sheet": [["generate", "shoes-v3-mini", "--objects", "3", "--touches", "4", "--seed", "3", "--out",
                       "DATASET"],
                      ["show", "DATASET", "--out", "OUT"]],
}
"""Words after `vsfsim` by picture; OUT, GIF and DATASET are places in a temporary folder."""
MODULES = {"generate": "vsfsim.generate.run", "press": "vsfsim.press.command", "show": "vsfsim.generate.inspect",
           "growth": "vsfsim.view.growth", "tradeoff": "measurements.tradeoff"}
MINUTES = {"solver": 10, "peers": 120, "tradeoff-foam-block": 30, "tradeoff-shoes-v3-mini": 60,
           "tradeoff-shoes-v2-punyo-mini": 60}
"""Of a CPU core, roughly; of any other product two."""


def digest(name: str) -> str:
    """sha256 of what the product ``name`` is made from; "" for a table of rows."""
    import make_measured

    from vsfsim.core.shelf import scenes

    if name in make_measured.RESULTS:
        return ""
    words = [word for line in PICTURES.get(name, [["tradeoff", name.removeprefix("tradeoff-")]
                                                  if name.startswith("tradeoff-") else [name]]) for word in line]
    modules = [MODULES[word] for word in words if word in MODULES] + ["vsfsim.view.growth"] * ("--method" in words)
    modules = modules or [f"measurements.{name.replace('-', '_')}"]
    files = {path for module in modules for path in code(module)}
    files |= {path for word in words for path in (scenes().get(word), ROOT / word) if path and path.is_file()}
    files |= {*ROOT.glob("scenes/*.py"), *ROOT.glob("scenes/tables/*.toml"), *ROOT.glob("vsfsim/core/*.toml")}
    parts = [json.dumps(words), *sorted(map(meaning, files))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@functools.cache
def code(module: str) -> list[Path]:
    """The files that a module passes through, of measurements/ and of `LAYERS` of vsfsim."""
    from vsfsim.core.system.content import source_files

    return list(source_files(module, of_vsfsim=lambda name: f"{name}..".split(".")[1] in ("", *LAYERS)).values())


@functools.cache
def meaning(path: Path) -> str:
    """sha256 of what a file says: of Python its syntax tree without docstrings, of any other its bytes."""
    if path.suffix != ".py":
        return hashlib.sha256(path.read_bytes()).hexdigest()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [one for one in body if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant)
                                                     and isinstance(one.value.value, str))]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def older() -> list[str]:
    """Names of the products that were made from something else than what is here."""
    import make_measured

    made = json.loads(MADE.read_text())
    return [name for name in (*PICTURES, *make_measured.MEASURED) if made.get(name, "") != digest(name)]


def make(name: str, files: list[Path]) -> None:
    """Make a product and write its digest down; that of what was measured before only if its commit had this code."""
    import make_measured

    if name in PICTURES:
        picture(name)
    else:
        make_measured.write(name, files)
    said, stored = digest(name), FOLDER / "measured" / f"{name}.jsonl"
    for file in [stored] if stored.exists() else files:
        text = file.read_text()
        there = json.loads(text.partition("\n")[0] if file == stored else text).get("commit", "")
        same = subprocess.run(["git", "diff", "--quiet", there, "--", "vsfsim", "scenes", "measurements"], cwd=ROOT)
        said = said if there and same.returncode == 0 else ""
    if name not in make_measured.RESULTS:
        MADE.write_text(json.dumps({**json.loads(MADE.read_text()), name: said}, indent=1, sort_keys=True) + "\n")


def picture(name: str) -> None:
    """Write ``pictures/NAME.png``, brought to 256 colours and `WIDTH` pixels, or ``NAME.webp`` of an animation."""
    with tempfile.TemporaryDirectory() as folder:
        out, gif = Path(folder) / "out.png", Path(folder) / "out.gif"
        for words in PICTURES[name]:
            places = {"OUT": str(out), "GIF": str(gif), "DATASET": str(Path(folder) / "dataset")}
            subprocess.run([sys.executable, "-c", "from vsfsim.cli.main import main; main()",
                            *(places.get(word, word) for word in words)], check=True, cwd=ROOT)
        if gif.exists():
            animate(gif, FOLDER / "pictures" / f"{name}.webp")
        else:
            shrink(out, FOLDER / "pictures" / f"{name}.png")


def animate(source: Path, to: Path) -> None:
    """Write a GIF as a WebP without loss, which is half as large."""
    from PIL import Image, ImageSequence

    frames = [(frame.convert("RGB"), frame.info["duration"]) for frame in ImageSequence.Iterator(Image.open(source))]
    (first, _), *others = frames
    first.save(to, save_all=True, append_images=[one for one, _ in others], duration=[time for _, time in frames],
               loop=0, lossless=True, method=6)


def shrink(source: Path, to: Path) -> None:
    """Bring a picture to the size of a page and to 256 colours."""
    from PIL import Image

    image = Image.open(source).convert("RGB")
    if image.width > WIDTH:
        image = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS)
    palette = image.quantize(256, method=Image.Quantize.FASTOCTREE)  # median cut loses the colours of small parts
    image.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(to, optimize=True)


def main(words: list[str]) -> int:
    """What the module says."""
    import make_measured

    if words == ["--check"]:
        names = older()
        print("".join(f"{name}: older than what it is made from; python docs/make.py {name}   # "
                      f"{MINUTES.get(name, 2)} CPU minutes\n" for name in names), end="")
        return bool(names)
    asked = make_measured.RESULTS if words == ["results"] else words or [*make_measured.RESULTS, *older()]
    for name, _, files in (word.partition("=") for word in asked):
        make(name, [Path(file) for file in files.split(",") if file])
    make_measured.write_readme()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
