"""Makes the pictures of the README: `python docs/make_pictures.py [NAME ...]`, five minutes on two CPU cores.

Each picture is written by the command that stands beside its name; a PNG is then brought to 256 colours and `WIDTH`
pixels.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

FOLDER = Path(__file__).parent / "pictures"
WIDTH = 1000  # px: what a page shows
PICTURES = {
    "shoe": [["show", "shoes-v3-mini", "--seed", "3", "--out", "OUT"]],
    "bubble": [["press", "punyo", "--picture", "OUT"]],
    "plant": [["press", "plants-v5-mini", "--seed", "1", "--picture", "OUT"]],
    "hidden": [["generate", str(FOLDER / "hidden.toml"), "--out", "DATASET"],
               ["show", "DATASET", "--method", "fem-map-seen", "--out", "GIF", *(
                   word for one in ("reach=0.02", "floor=0.02", "share=0.05", "objects=3", "presses=6")
                   for word in ("--set", one))]],
    "press": [["press", "indent", "--tier", "fem", "--gif", "GIF"]],
    "accuracy": [["lab", "tradeoff", "foam-block", "--touches", "2", "--picture", "OUT"]],  # of tradeoff/foam-block
    "contact-sheet": [["generate", "shoes-v3-mini", "--objects", "3", "--touches", "4", "--seed", "3", "--out",
                       "DATASET"],
                      ["show", "DATASET", "--out", "OUT"]],
}
"""Words after `vsfsim` by picture; OUT, GIF and DATASET are places in a temporary folder."""


def make(name: str) -> None:
    """Write ``pictures/NAME.png``, or ``NAME.gif``."""
    with tempfile.TemporaryDirectory() as folder:
        out, gif = Path(folder) / "out.png", Path(folder) / "out.gif"
        for words in PICTURES[name]:
            places = {"OUT": str(out), "GIF": str(gif), "DATASET": str(Path(folder) / "dataset")}
            subprocess.run([sys.executable, "-c", "from vsfsim.cli.main import main; main()",
                            *(places.get(word, word) for word in words)], check=True)
        if gif.exists():
            shutil.copyfile(gif, FOLDER / gif.with_stem(name).name)
        else:
            shrink(out, FOLDER / f"{name}.png")


def shrink(picture: Path, to: Path) -> None:
    """Bring a picture to the size of a page and to 256 colours."""
    image = Image.open(picture).convert("RGB")
    if image.width > WIDTH:
        image = image.resize((WIDTH, round(image.height * WIDTH / image.width)), Image.Resampling.LANCZOS)
    palette = image.quantize(256, method=Image.Quantize.FASTOCTREE)  # median cut loses the colours of small parts
    image.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(to, optimize=True)


if __name__ == "__main__":
    for wanted in sys.argv[1:] or PICTURES:
        make(wanted)
